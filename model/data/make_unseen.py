"""Makes unseen.npz here: the speakers whom simulated recordings play without computing them. Some seconds.

python -m tonguetrack.model.data.make_unseen
"""

from __future__ import annotations

from pathlib import Path

from ...atomic import write_atomically
from ..mri.phantom.unseen import SHIPPED, computed_speaker, unseen_file

if __name__ == "__main__":
    speakers = [computed_speaker(number) for number in SHIPPED]
    print(write_atomically(Path(__file__).with_name("unseen.npz"), unseen_file(speakers)))
