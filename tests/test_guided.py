"""A live session that begins with a calibration: what is asked for, what is kept, what is made of it."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import FrameOfReference, ReplaySource, open_recording, write_recording
from tonguetrack.tracker import guided
from tonguetrack.tracker.cli.guiding import check_axes
from tonguetrack.tracker.guided import BITE_PLANE, PALATE, REST, SPEECH, parts_for, record_parts
from tonguetrack.tracker.session import load_session
from tonguetrack.tracker.simulation import HEAD_COILS, Simulation, simulate

TONGUE = ("tongue_tip", "tongue_blade", "tongue_dorsum")
TONGUETRACK = [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())"]


@pytest.fixture(scope="module")
def sweep():
    """A speaker with reference coils, whose head moves."""
    phones = ("ə", "i", "ə", "ɑ", "ə", "u", "ə", "s", "a", "ʃ", "i", "ɔ", "ə")
    recording, _ = simulate(
        Simulation(phones, (*TONGUE, *HEAD_COILS), seconds=12.0, rate_hz=100.0, head_motion=True)
    )
    return recording


def test_what_is_asked_for_depends_on_the_coils():
    assert [part.name for part in parts_for(TONGUE)] == ["speech"]
    assert [part.name for part in parts_for((*TONGUE, *HEAD_COILS))] == ["rest", "speech"]
    everything = (*TONGUE, *HEAD_COILS, "bite_front", "bite_left", "bite_right", "palate_probe")
    assert [part.name for part in parts_for(everything)] == ["rest", "bite_plane", "palate", "speech"]
    with pytest.raises(InputError, match="no coil is on the tongue"):
        parts_for(HEAD_COILS)


def test_every_part_is_on_disk_as_it_was_measured_one_after_the_other(sweep, tmp_path):
    parts = [replace(part, seconds=2.0) for part in (REST, PALATE, SPEECH)]
    asked = []
    files = record_parts(
        ReplaySource(sweep, speed=None),
        parts,
        tmp_path / "new",
        lambda part: not asked.append(part.name),
        print,
    )
    assert asked == ["rest", "palate", "speech"]
    kept = [open_recording(files[name]) for name in asked]
    assert all(recording.coils == sweep.coils for recording in kept)
    together = np.concatenate([recording.positions for recording in kept])
    np.testing.assert_array_equal(together, sweep.positions[: len(together)])
    assert min(recording.frame_count for recording in kept) >= 200


def test_a_folder_with_something_in_it_is_left_alone(sweep, tmp_path):
    (tmp_path / "rest.npz").write_bytes(b"precious")
    with pytest.raises(InputError, match="name a new folder"):
        record_parts(ReplaySource(sweep, speed=None), [REST], tmp_path, lambda part: True, print)
    assert (tmp_path / "rest.npz").read_bytes() == b"precious"


def test_who_ends_it_keeps_what_was_recorded(sweep, tmp_path):
    parts = [replace(part, seconds=1.0) for part in (REST, SPEECH)]
    with pytest.raises(InputError, match="ended before its last part"):
        record_parts(
            ReplaySource(sweep, speed=None), parts, tmp_path / "new", lambda part: part.name == "rest", print
        )
    assert (tmp_path / "new" / "rest.npz").exists()


def test_a_source_that_ends_too_early_is_named_with_the_part(sweep, tmp_path):
    parts = [replace(part, seconds=7.0) for part in (REST, SPEECH, SPEECH)]
    told = []
    with pytest.raises(InputError, match=r"calibration, speech: .*ended before its first frame"):
        record_parts(ReplaySource(sweep, speed=None), parts, tmp_path / "new", lambda part: True, told.append)
    assert "7.0 of 7 s" in told[0] and "5.0 of 7 s" in told[1]


def test_axes_that_nobody_states_are_asked_for_before_the_speaker_does_anything(sweep):
    silent = ReplaySource(replace(sweep, frame=FrameOfReference()))
    with pytest.raises(InputError, match='--frame "front left up"'):
        check_axes(silent, [REST, SPEECH], None)
    check_axes(silent, [BITE_PLANE, SPEECH], None)
    check_axes(silent, [SPEECH], FrameOfReference("front", "left", "up"))
    check_axes(ReplaySource(sweep), [SPEECH], None)


def test_a_folder_that_cannot_be_made_is_one_sentence(sweep, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match=r"this folder cannot be made .*--calibrate"):
        record_parts(ReplaySource(sweep), [REST], tmp_path / "file" / "new", lambda part: True, print)


def test_the_command_calibrates_and_goes_on_with_what_it_found(sweep, tmp_path):
    write_recording(sweep, tmp_path / "sweep.npz")
    done = subprocess.run(
        [*TONGUETRACK, "live", f"replay:{tmp_path}/sweep.npz?speed=max&loop=1", "--calibrate", str(tmp_path / "first"),
         "--seconds", "3", "--osc", "127.0.0.1:9", "--json"],
        capture_output=True, text=True, timeout=240, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "REST: hold the head still" in done.stderr and "SPEECH: say slowly" in done.stderr
    session = load_session(tmp_path / "first" / "session.toml")
    assert session.head is not None and session.speaker_weights is not None
    assert set(session.correspondences) == set(TONGUE)
    assert (tmp_path / "first" / "speech.npz").exists() and (tmp_path / "first" / "report.md").exists()


def test_frame_without_calibrate_is_refused(tmp_path):
    done = subprocess.run(
        [*TONGUETRACK, "live", "simulate:", "--frame", "front left up"],
        capture_output=True, text=True, timeout=60, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2 and "--frame goes with --calibrate" in done.stderr


def test_the_prompts_name_what_a_speaker_can_do():
    for part in (guided.REST, guided.BITE_PLANE, guided.PALATE, guided.SPEECH):
        assert part.seconds > 0 and part.words == part.words.strip() and part.words[0].islower()
