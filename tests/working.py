"""What the tests of `parallel` have workers do: functions that another process can import."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from tonguetrack import InputError


def squared(number):
    if number == 7:
        raise InputError("7: nobody squares sevens.")
    return number * number


def twice(number):
    return {"twice": np.array([2.0 * number])}


def slow_at_first(number):
    """The earlier an item, the later it is finished."""
    time.sleep(0.02 * max(0, 6 - number))
    return number


def with_a_bug(number):
    raise KeyError(f"no {number}")


def threads(_):
    return {name: value for name, value in os.environ.items() if name.endswith("_NUM_THREADS")}


def told(folder, number):
    """Leaves a file behind for every item that was begun."""
    Path(folder, str(number)).touch()
    return number


def dying(number):
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def sleeping(folder, number):
    """Leaves its process's number behind, and sleeps for longer than any test."""
    Path(folder, str(os.getpid())).touch()
    time.sleep(600)
    return number
