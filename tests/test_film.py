"""Films, pictures and stills as a specification: what `tonguetrack render` writes, seen by an outside player."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import wave
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from displays import absent, require_egl
from PIL import Image

from tonguetrack import InputError
from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.cli.showing import read_ghost, scene_to_show
from tonguetrack.tracker.palate import curve_palate
from tonguetrack.tracker.pose import TrackedPoses
from tonguetrack.tracker.posefiles import read_poses, write_poses
from tonguetrack.tracker.session import Session, session_toml
from tonguetrack.tracker.viewer import film
from tonguetrack.tracker.viewer.camera import flat_projection, layout_of
from tonguetrack.tracker.viewer.film import Shot
from tonguetrack.tracker.viewer.look import DARK, LIGHT
from tonguetrack.tracker.viewer.scene import moments_of

SMALL = ["--size", "320x240"]
FRAMES, RATE_HZ = 21, 20.0
COMMAND = ("-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))")


def made_poses():
    """One second in which the first weight goes from -1 to 1 sigma and the coils follow their vertices."""
    model = bundled_model()
    _, session = bundled_recording()
    roles, vertices = tuple(session.correspondences), tuple(session.correspondences.values())
    normalised = np.zeros((FRAMES, model.pose.size))
    normalised[:, 0] = np.linspace(-1, 1, FRAMES)
    weights = model.pose.raw(normalised)
    speakers = np.tile(session.speaker_weights, (FRAMES, 1))
    coils = np.array([model.vertices(s, w)[list(vertices)] for s, w in zip(speakers, weights, strict=True)])
    nothing = np.zeros(FRAMES)
    return TrackedPoses(
        np.arange(FRAMES) / RATE_HZ, np.ones(FRAMES, np.int64), weights, normalised, speakers, nothing, nothing,
        np.zeros((FRAMES, len(roles))), coils, None, roles, vertices, 2, RATE_HZ, "bundled", model.fingerprint, model.name,
    )  # fmt: skip


@pytest.fixture
def take(tmp_path, monkeypatch):
    """A folder with poses.csv in it, where the test runs."""
    monkeypatch.chdir(tmp_path)
    write_poses(made_poses(), bundled_model(), "poses.csv")
    return tmp_path


@pytest.fixture
def drawn(take):
    require_egl()
    return take


def sound(path, seconds, rate_hz=16000, channels=1):
    """Silence for the first half, a tone in the second."""
    times = np.arange(int(seconds * rate_hz)) / rate_hz
    tone = np.where(times < seconds / 2, 0, 12000 * np.sin(2 * np.pi * 440 * times)).astype("<i2")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(2)
        file.setframerate(rate_hz)
        file.writeframes(np.repeat(tone, channels).tobytes())


def probed(path):
    """What ffprobe says of the streams, by kind."""
    if shutil.which("ffprobe") is None:
        absent("ffprobe is not installed (Debian: apt install ffmpeg)")
    command = ["ffprobe", "-v", "error", "-show_streams", "-count_frames", "-of", "json", str(path)]
    done = subprocess.run(command, capture_output=True, check=True, text=True)
    assert done.stderr == ""
    return {stream["codec_type"]: stream for stream in json.loads(done.stdout)["streams"]}


def picture_at(path, number):
    """(h, w, 3): a picture of the film, taken out by ffmpeg."""
    out = path.with_name(f"out{number}.png")
    pick = ["-vf", f"select=eq(n\\,{number})", "-frames:v", "1", str(out)]
    subprocess.run(["ffmpeg", "-v", "error", "-y", "-i", str(path), *pick], check=True)
    return np.asarray(Image.open(out).convert("RGB"))


def unlike(one, other):
    """(h, w) where brightness differs: films keep colours for two by two pixels only."""
    return np.abs((one.astype(float) - other.astype(float)) @ [0.30, 0.59, 0.11]) > 20


# Films ----------------------------------------------------------------------------------------------


def test_a_film_is_h264_as_long_as_the_take_with_the_tongue_moving(drawn):
    pytest.importorskip("av")
    assert main(["render", "poses.csv", "-o", "film.mp4", "--fps", "30", *SMALL]) == 0
    streams = probed(drawn / "film.mp4")
    video = streams["video"]
    assert set(streams) == {"video"}
    assert (video["codec_name"], video["width"], video["height"], video["pix_fmt"]) == (
        "h264",
        320,
        240,
        "yuv420p",
    )
    assert video["avg_frame_rate"] == "30/1" and video["nb_read_frames"] == "31"
    assert [path.name for path in drawn.iterdir() if path.suffix == ".part"] == []
    first, last = (picture_at(drawn / "film.mp4", n) for n in (0, 30))
    assert unlike(first, last).mean() > 0.01


def test_the_films_pictures_are_those_of_the_interpolated_poses(drawn):
    """Frame 7 is 0.35 s; picture 21 of a film of 60 a second is the same moment, picture 22 lies between two frames."""
    pytest.importorskip("av")
    assert main(["render", "poses.csv", "-o", "film.mp4", "--fps", "60", *SMALL]) == 0
    assert main(["render", "poses.csv", "-o", "still.png", "--frame", "7", *SMALL]) == 0
    still = np.asarray(Image.open("still.png").convert("RGB"))
    same, between = (picture_at(drawn / "film.mp4", n) for n in (21, 22))
    assert unlike(still, same).mean() < 0.01
    poses = read_poses("poses.csv")
    shot = Shot(scene_of_poses(poses), moments_of(poses), size=(320, 240), fps=60)
    pictures = list(shot.pictures())
    assert len(pictures) == 61
    assert unlike(pictures[22], between).mean() < 0.01
    assert not np.array_equal(pictures[21], pictures[22]) and not np.array_equal(pictures[22], pictures[23])


def scene_of_poses(poses):
    return scene_to_show(poses, bundled_model(), Session(), "poses")


def test_the_tongue_of_the_poses_is_inside_the_picture_even_where_no_session_says_whose_it_is(drawn):
    poses, model = read_poses("poses.csv"), bundled_model()
    for another in (poses.speaker_weights, 3.0 * poses.speaker_weights):
        moved = replace(poses, speaker_weights=another)
        scene = scene_of_poses(moved)
        area = layout_of((640, 360), DARK).flat
        flat = flat_projection(scene, area, 10)
        for frame in range(0, moved.frame_count, 5):
            vertices = model.vertices(another[frame], moved.weights[frame])
            assert all(area.holds(x, y) for x, y in flat.pixels(vertices)[:, :2])


@pytest.mark.parametrize(
    ("seconds", "rate_hz", "channels"), [(3.0, 16000, 1), (0.6, 44100, 2), (1.0, 96000, 1)]
)
def test_sound_goes_with_the_film_from_second_0_and_as_far_as_it_does(drawn, seconds, rate_hz, channels):
    av = pytest.importorskip("av")
    sound("take.wav", seconds, rate_hz, channels)
    assert main(["render", "poses.csv", "-o", "film.mp4", "--audio", "take.wav", "--fps", "25", *SMALL]) == 0
    voice = probed(drawn / "film.mp4")["audio"]
    expected_hz = min(rate_hz, 48000)
    assert (voice["codec_name"], int(voice["sample_rate"])) == ("aac", expected_hz)
    assert voice["channels"] == channels
    assert float(voice["duration"]) == pytest.approx(min(seconds, 26 / 25), abs=0.05)
    with av.open("film.mp4") as opened:
        samples = np.concatenate([frame.to_ndarray()[0] for frame in opened.decode(audio=0)])
    loud = np.flatnonzero(np.abs(samples) > 0.1) / expected_hz
    if seconds / 2 < 1.0:
        assert loud[0] == pytest.approx(seconds / 2, abs=0.06), "the tone begins where it began"
    else:
        assert len(loud) == 0, "the film is over before the tone"


@pytest.mark.parametrize(("begin_s", "tone_s"), [(0.5, 0.5), (-0.5, 1.0)])
def test_poses_that_begin_later_or_earlier_than_the_sound_keep_their_place(tmp_path, begin_s, tone_s):
    pytest.importorskip("av")
    from tonguetrack.tracker.viewer.sound import read_sound

    sound(tmp_path / "take.wav", 2.0)  # the tone begins at 1 s
    voice = read_sound(tmp_path / "take.wav", begin_s)
    pieces = []
    while (piece := voice.take(1000)) is not None:
        assert piece.shape[0] == 1 and 0 < piece.shape[1] <= 1000
        pieces.append(piece[0])
    samples = np.concatenate(pieces)
    assert len(samples) == pytest.approx((2.0 - begin_s) * 16000, abs=50)
    loud_s = np.flatnonzero(np.abs(samples) > 0.1)[0] / 16000
    assert loud_s == pytest.approx(1.0 - begin_s, abs=0.01)


def test_sound_that_is_none_or_over_is_one_sentence(drawn, capsys):
    pytest.importorskip("av")
    sound("short.wav", 0.2)
    (drawn / "noise.wav").write_bytes(b"RIFF not a sound at all" * 20)
    late = replace(made_poses(), times_s=made_poses().times_s + 9.0)
    write_poses(late, bundled_model(), "late.csv")
    for poses, audio, words in [
        ("late.csv", "short.wav", "short.wav: it has no sound at 9 s, where the poses begin"),
        ("poses.csv", "noise.wav", "noise.wav: the sound cannot be read"),
        ("poses.csv", "nowhere.wav", "nowhere.wav: the sound cannot be read"),
    ]:
        assert main(["render", poses, "-o", "film.mp4", "--audio", audio, *SMALL]) == 2
        told = capsys.readouterr().err
        assert words in told and told.count("\n") == 1
        assert not (drawn / "film.mp4").exists()


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_a_film_that_is_stopped_leaves_no_half_film(drawn, number):
    pytest.importorskip("av")
    (drawn / "film.mp4").write_bytes(b"the film of yesterday")
    run = subprocess.Popen(
        [sys.executable, *COMMAND, "render", "poses.csv", "-o", "film.mp4", "--fps", "1000", *SMALL],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    end_s = time.monotonic() + 60
    while not list(drawn.glob(".film*")) and time.monotonic() < end_s and run.poll() is None:
        time.sleep(0.02)
    time.sleep(0.5)
    run.send_signal(signal.Signals[number])
    _, told = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.Signals[number], told
    assert "Traceback" not in told and ("stopped" in told) is (number == "SIGINT")
    assert sorted(path.name for path in drawn.iterdir()) == ["film.mp4", "poses.csv"]
    assert (drawn / "film.mp4").read_bytes() == b"the film of yesterday"


def test_without_the_extra_a_film_becomes_pictures_and_a_command(drawn, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    sound("take.wav", 1.0)
    assert main(["render", "poses.csv", "-o", "film.mp4", "--fps", "5", "--audio", "take.wav", *SMALL]) == 0
    told = capsys.readouterr().err
    assert "pip install 'tonguetrack[video]'" in told
    assert sorted(path.name for path in drawn.glob("*.png")) == [f"film_{n:06d}.png" for n in range(6)]
    command = told.split("ffmpeg makes a film of them: ")[1].splitlines()[0].split()
    if shutil.which("ffmpeg") is None:
        absent("ffmpeg is not installed")
    subprocess.run([*command, "-v", "error"], check=True, timeout=60)
    assert set(probed(drawn / "film.mp4")) == {"video", "audio"}


# Pictures -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["film.webp", "film.gif"])
def test_a_picture_that_moves_has_the_part_of_the_take_that_was_asked_for(drawn, name):
    assert main(["render", "poses.csv", "-o", name, "--fps", "20", "--seconds", "0.25:0.75", *SMALL]) == 0
    assert main(["render", "poses.csv", "-o", "still.png", "--frame", "5", *SMALL]) == 0
    film = Image.open(drawn / name)
    assert (film.n_frames, film.size) == (11, (320, 240))
    first = np.asarray(film.convert("RGB"))
    film.seek(10)
    film.load()
    assert film.info["duration"] == 50
    # Frame 5 is 0.25 s; a still has the trails that lead there, the first picture of a film has none.
    assert unlike(np.asarray(Image.open("still.png").convert("RGB")), first).mean() < 0.06
    assert unlike(first, np.asarray(film.convert("RGB"))).mean() > 0.01


@pytest.mark.parametrize(
    ("output", "names"),
    [
        ("tongue.png", "tongue_{:06d}.png"),
        ("folder/", "folder/tongue_{:06d}.png"),
        ("there", "there/tongue_{:06d}.png"),
    ],
)
def test_pictures_are_numbered_beside_the_name_or_in_the_folder(drawn, output, names):
    (drawn / "there").mkdir()
    assert main(["render", "poses.csv", "-o", output, "--fps", "2", *SMALL]) == 0
    found = sorted(path.relative_to(drawn).as_posix() for path in drawn.rglob("*.png"))
    assert found == [names.format(number) for number in range(3)]
    assert Image.open(found[0]).size == (320, 240)


def test_a_still_is_one_frame_with_its_coils_and_trails(drawn):
    assert main(["render", "poses.csv", "-o", "a.png", "--frame", "20"]) == 0
    assert main(["render", "poses.csv", "-o", "b.png", "--frame", "0", "--light"]) == 0
    dark, light = (np.asarray(Image.open(name)) for name in ("a.png", "b.png"))
    assert dark.shape == (720, 1280, 3)
    corners = [
        (np.round(255 * np.array(look.background)), p[-3, 3]) for look, p in ((DARK, dark), (LIGHT, light))
    ]
    for ground, corner in corners:
        assert np.abs(ground - corner).max() <= 2


def test_a_ghost_a_colour_and_another_speaker_change_the_picture(drawn):
    session = bundled_recording()[1]
    y = np.arange(5.0, 50.0, 5.0)
    palate = curve_palate(
        np.column_stack([np.zeros_like(y), y, 20.0 - 0.01 * (y - 25.0) ** 2]), "made for a test"
    )
    poses = made_poses()
    backwards = replace(poses, weights=poses.weights[::-1], normalised=poses.normalised[::-1])
    write_poses(backwards, bundled_model(), "backwards.csv")
    (drawn / "s.toml").write_text(session_toml(replace(session, palate=palate)))
    pictures = {}
    for name, more in {
        "plain": [],
        "ghost": ["--ghost", "poses.csv@1.0"],
        "running": ["--ghost", "backwards.csv"],
        "uncertain": ["--colour", "uncertainty"],
        "palate": ["--colour", "palate", "--session", "s.toml"],
        "other": ["--speaker=" + ",".join(str(w) for w in session.speaker_weights * 0.8)],
    }.items():
        assert main(["render", "poses.csv", "-o", f"{name}.png", "--frame", "0", *more]) == 0
        pictures[name] = np.asarray(Image.open(f"{name}.png"))
    for name in ("ghost", "uncertain", "palate", "other"):
        assert unlike(pictures["plain"], pictures[name]).mean() > 0.01, name
    ghost_px = {
        name: (np.abs(pictures[name][:, 700:] - np.round(255 * np.array(DARK.ghost))).max(axis=-1) < 40).sum()
        for name in ("plain", "ghost", "running")
    }
    assert ghost_px["plain"] < 50
    assert min(ghost_px["ghost"], ghost_px["running"]) > 200


def test_a_take_is_drawn_with_the_session_in_it(drawn, capsys):
    command = [
        "live",
        "simulate:?seconds=2",
        "--seconds",
        "1",
        "--record",
        "take.xdf",
        "--osc",
        "127.0.0.1:9",
    ]
    session = Path(__file__).resolve().parents[1] / "recordings" / "demo.session.toml"
    assert main([*command, "--session", str(session), "--control", "127.0.0.1:0"]) == 0
    assert main(["render", "take.xdf", "-o", "a.png", "--frame", "100", *SMALL]) == 0
    assert "take, tonguetrack synthetic tongue" in capsys.readouterr().err
    assert read_ghost("take.xdf@0.5", bundled_model()).frame_count == 1
    assert unlike(np.asarray(Image.open("a.png")), np.round(255 * np.array(DARK.background))).mean() > 0.1


def test_a_ghost_belongs_to_the_model_that_is_shown_wherever_that_is(take):
    """Not to the one that its file names: that may have been moved, and a take names none."""
    other = bundled_model().truncated(5, 3)
    poses = made_poses()
    poses = replace(
        poses, weights=poses.weights[:, :3], normalised=poses.normalised[:, :3], model_path="nowhere.npz",
        model_fingerprint=other.fingerprint,
    )  # fmt: skip
    write_poses(poses, other, "other.csv")
    assert read_ghost("other.csv@0.5", other).frame_count == 1
    with pytest.raises(InputError, match="tracked with the model"):
        read_ghost("other.csv", bundled_model())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "a.avi"], "films are written as .mp4, .webp or .gif, pictures as .png"),
        (["-o", "a.webp", "--seconds", "0.5"], "--seconds 0.5: expected a first and a last second"),
        (
            ["-o", "a.webp", "--seconds", "0.5:2"],
            "poses, tonguetrack synthetic tongue has the seconds 0 to 1",
        ),
        (["-o", "a.webp", "--seconds", "0.5:0.2"], "--seconds 0.5:0.2"),
        (["-o", "a.webp", "--seconds", "nan:0.2"], "--seconds nan:0.2"),
        (["-o", "a.png", "--seconds", "0:1", "--frame", "2"], "--frame makes one picture, --seconds many"),
        (["-o", "a.mp4", "--frame", "3"], "--frame makes one picture"),
        (["-o", "a.png", "--audio", "x.wav"], "--audio belongs to a film"),
        (
            ["-o", "a.png", "--frame", "21"],
            "--frame 21: poses, tonguetrack synthetic tongue has the frames 0 to 20",
        ),
        (["-o", "a.png", "--frame", "-1"], "--frame -1"),
        (["-o", "a.png", "--size", "big"], "--size big: expected a width and a height"),
        (["-o", "a.png", "--size", "20x20"], "--size 20x20: expected 160 to 8192 pixels"),
        (["-o", "a.png", "--fps", "0"], "--fps 0: expected 0.01 to 1000"),
        (["-o", "a.png", "--fps", "nan"], "--fps nan: expected 0.01 to 1000"),
        (["-o", "a.mp4", "--fps", "0.0001"], "--fps 0.0001: expected 0.01 to 1000"),
        (["-o", "a.webp", "--fps", "1000", "--size", "8192x8192"], "GiB of memory"),
        (["-o", "a.png", "--colour", "palate"], "no palate is known"),
        (["-o", "a.png", "--ghost", "nowhere.csv"], "nowhere.csv: there is no such poses file"),
        (["-o", "a.png", "--ghost", "poses.csv@7"], "poses.csv lasts from 0 s to 1 s"),
        (["-o", "poses.csv/a.png"], "poses.csv/a.png"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence_and_leaves_nothing(take, capsys, arguments, words):
    if "--frame" in arguments:
        require_egl()
    assert main(["render", "poses.csv", *arguments]) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1
    assert [path.name for path in take.iterdir()] == ["poses.csv"]


def test_a_film_with_an_odd_side_is_refused_with_an_even_one(drawn, capsys):
    pytest.importorskip("av")
    assert main(["render", "poses.csv", "-o", "a.mp4", "--size", "321x240"]) == 2
    assert "such as 322x240" in capsys.readouterr().err


def test_poses_without_vertices_are_drawn_without_coils_and_it_is_said(drawn, capsys):
    write_poses(made_poses_with_vertices(), bundled_model(), "poses.json")
    assert main(["render", "poses.json", "--model", "bundled", "-o", "a.png", "--frame", "3", *SMALL]) == 0
    assert "the coils are not shown" in capsys.readouterr().err
    _, session = bundled_recording()
    (drawn / "s.toml").write_text(session_toml(session))
    command = [
        "render",
        "poses.json",
        "--model",
        "bundled",
        "--session",
        "s.toml",
        "-o",
        "b.png",
        "--frame",
        "3",
    ]
    assert main([*command, *SMALL]) == 0
    assert "not shown" not in capsys.readouterr().err
    with_coils, without = (np.asarray(Image.open(name)) for name in ("b.png", "a.png"))
    assert unlike(with_coils, without).sum() > 100


def made_poses_with_vertices():
    poses = made_poses()
    return replace(poses, vertices=poses.coils)


def test_the_shot_checks_itself():
    poses = made_poses()
    with pytest.raises(InputError, match="fps"):
        Shot(scene_of_poses(poses), moments_of(poses), fps=1e9)
    assert film.numbered(Path("x/tongue.png"), 42).as_posix() == "x/tongue_000042.png"
