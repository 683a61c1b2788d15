"""What a preference test came to: shares per scan, per speaker and over all, for people and programs.

The interval of a share is Wilson's. Answers of one participant resemble each other, and so do answers about one scan;
where a share is over several of both, the interval is as wide as if there were only so many independent answers as
make its variance equal to the one that is found between participants and between scans (standard errors clustered both
ways, and a t quantile with as many degrees of freedom as the fewer of them have).
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import InputError, __version__
from ...atomic import write_atomically
from .preference import FINAL, INITIAL, PreferenceTest
from .preferenceanswers import SIDES, Sitting, all_sittings
from .reading import library

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONFIDENCE = 0.95
TALLY_FILES = ("tally.json", "scans.csv", "answers.csv", "tally.txt", "preference.png", "preference.svg")
COLUMNS = 4  # of the figure
FOR_FINAL, FOR_INITIAL = "#2f6f9f", "#d9863d"


@dataclass(frozen=True)
class Answer:
    """One participant's last word on one slice. place: where it came in their order, from 1; left: the method whose
    contour was on the left; chosen: the one that was preferred."""

    participant: str
    partition: int
    place: int
    speaker: str
    phone: str
    at_mm: float
    left: str
    chosen: str


@dataclass(frozen=True)
class Share:
    """Of `count` answers, `final` preferred the contour after bootstrapping. low, high: the 95 % interval of that
    share. Without answers share, low and high are NaN."""

    count: int
    final: int
    low: float
    high: float

    @property
    def share(self) -> float:
        return self.final / self.count if self.count else math.nan


@dataclass(frozen=True)
class ScanShare:
    """One scan, all its slices together."""

    speaker: str
    phone: str
    share: Share

    @property
    def initial_won(self) -> bool:
        """Whether half of the answers or more preferred the first matching, as the paper counts them."""
        return self.share.count > 0 and 2 * self.share.final <= self.share.count


@dataclass(frozen=True)
class ParticipantShare:
    """What one participant did. left: how many of the choices fell on the left picture; damaged: unreadable lines."""

    name: str
    partition: int
    answered: int
    total: int
    share: Share
    left: int
    damaged: int


@dataclass(frozen=True)
class Tally:
    """scans: in the test's order of speakers and phones, also those without an answer."""

    test: PreferenceTest
    answers: tuple[Answer, ...]
    overall: Share
    speakers: tuple[tuple[str, Share], ...]
    scans: tuple[ScanShare, ...]
    participants: tuple[ParticipantShare, ...]

    @property
    def initial_won(self) -> tuple[ScanShare, ...]:
        """The scans where half of the answers or more preferred the first matching, clearest first."""
        return tuple(
            sorted((scan for scan in self.scans if scan.initial_won), key=lambda scan: scan.share.share)
        )


def tally(test: PreferenceTest) -> Tally:
    """Counts all answers so far. Raises InputError where there are none, or they belong to another test."""
    sittings = all_sittings(test)
    answers = tuple(answer for sitting in sittings for answer in _answers(test, sitting))
    if not answers:
        raise InputError(
            f"{test.folder}: nobody has answered yet; let people judge with 'mri preference serve'."
        )
    scans: dict[tuple[str, str], list[Answer]] = {(item.speaker, item.phone): [] for item in test.items}
    speakers: dict[str, list[Answer]] = {item.speaker: [] for item in test.items}
    for answer in answers:
        scans[answer.speaker, answer.phone].append(answer)
        speakers[answer.speaker].append(answer)
    return Tally(
        test,
        answers,
        share_of(answers),
        tuple((name, share_of(own)) for name, own in speakers.items()),
        tuple(ScanShare(*cell, share_of(own)) for cell, own in scans.items()),
        tuple(_participant(sitting, _answers(test, sitting)) for sitting in sittings),
    )


def share_of(answers: Sequence[Answer]) -> Share:
    """The share for bootstrapping in these answers, with the interval of the module's docstring."""
    votes = np.array([answer.chosen == FINAL for answer in answers], dtype=np.float64)
    count, final = len(votes), int(votes.sum())
    if not count:
        return Share(0, 0, math.nan, math.nan)
    groups = [
        np.unique(names, return_inverse=True)[1]
        for names in (
            [answer.participant for answer in answers],
            [f"{answer.speaker}\n{answer.phone}" for answer in answers],
        )
    ]
    low, high = clustered_interval(votes, groups)
    return Share(count, final, low, high)


def clustered_interval(votes: np.ndarray, groups: Iterable[np.ndarray]) -> tuple[float, float]:
    """The interval of the mean of votes (n,), 0 or 1, that are alike within groups: of each way of grouping, (n,) the
    number of every vote's group. Groups of one vote each say nothing, nor does one group of all."""
    from scipy.stats import t as student

    count, share = len(votes), float(votes.mean())
    independent = share * (1 - share) / count
    deviations = votes - share
    variance, clustered, fewest = independent, [], math.inf
    for group in groups:
        sizes = np.bincount(group)
        if not 1 < len(sizes) < count:
            continue
        sums = np.bincount(group, deviations)
        clustered.append(float((sums**2).sum()) / count**2 * len(sizes) / (len(sizes) - 1))
        fewest = min(fewest, len(sizes) - 1)
    if clustered:  # what answers vary by themselves is in each of them
        variance = max(independent, *clustered, sum(clustered) - (len(clustered) - 1) * independent)
    effective = count * independent / variance if variance > 0 else count
    return wilson(share, effective, float(student.ppf(0.5 + CONFIDENCE / 2, fewest)))


def wilson(share: float, count: float, quantile: float) -> tuple[float, float]:
    """Wilson's interval of a share of `count` independent answers; quantile: 1.96 for 95 %."""
    square = quantile**2 / count
    middle = (share + square / 2) / (1 + square)
    half = quantile / (1 + square) * math.sqrt(share * (1 - share) / count + square / (4 * count))
    return max(0.0, middle - half), min(1.0, middle + half)


def _answers(test: PreferenceTest, sitting: Sitting) -> list[Answer]:
    found = []
    for place, chosen in sorted(sitting.chosen.items()):
        shown = sitting.shown[place]
        item = test.items[shown.item]
        found.append(
            Answer(
                sitting.participant, sitting.partition, place + 1, item.speaker, item.phone, item.at_mm, shown.left,
                chosen,
            )
        )  # fmt: skip
    return found


def _participant(sitting: Sitting, answers: Sequence[Answer]) -> ParticipantShare:
    return ParticipantShare(
        sitting.participant,
        sitting.partition,
        len(answers),
        len(sitting.shown),
        share_of(answers),
        sum(answer.left == answer.chosen for answer in answers),
        sitting.damaged,
    )


# For people and programs ----------------------------------------------------------------------------


def as_text(result: Tally) -> str:
    """Over all, per speaker, the scans where the first matching won, and who took part."""
    overall, scans = result.overall, result.scans
    judged = sum(scan.share.count > 0 for scan in scans)
    summary = (
        f"Bootstrapping was preferred in {_percent(overall.share)} % of {overall.count} answers "
        f"(95 % interval {_interval(overall)} %), by {sum(who.answered > 0 for who in result.participants)} "
        f"participants on {judged} of {len(scans)} scans."
    )
    lines = [
        f"{result.test.source}{_made_up(result)}",
        summary,
        "",
        f"{'speaker':24}{'answers':>8}{'for it':>9}{'95 % interval':>16}",
    ]
    for name, share in result.speakers:
        lines.append(
            f"{name:24}{share.count:8d}{_percent(share.share) + ' %':>9}{_interval(share) + ' %':>16}"
        )
    won = result.initial_won
    lines += ["", f"Scans where half of the answers or more preferred the first matching: {len(won)}"]
    for scan in won:
        share = scan.share
        lines.append(f"  {scan.speaker} [{scan.phone}]: {share.count - share.final} of {share.count}")
    unanswered = len(scans) - judged
    if unanswered:
        lines += ["", f"Scans that nobody has judged: {unanswered}"]
    lines += ["", f"{'participant':24}{'part':>5}{'judged':>10}{'for it':>9}{'left':>8}"]
    for who in result.participants:
        done, left = (
            f"{who.answered}/{who.total}",
            _percent(who.left / who.answered if who.answered else math.nan),
        )
        lines.append(
            f"{who.name:24}{who.partition:5d}{done:>10}{_percent(who.share.share) + ' %':>9}{left + ' %':>8}"
            + (f"  ({who.damaged} lines of the file are damaged)" if who.damaged else "")
        )
    return "\n".join(lines)


def as_json(result: Tally) -> dict[str, Any]:
    """Everything, as plain values; null where there are no answers."""

    def plain(share: Share) -> dict[str, Any]:
        numbers = {"share": share.share, "low": share.low, "high": share.high}
        rounded = {name: None if math.isnan(value) else round(value, 6) for name, value in numbers.items()}
        return {"answers": share.count, FINAL: share.final, INITIAL: share.count - share.final, **rounded}

    return {
        "program": f"tonguetrack {__version__}",
        "source": result.test.source,
        "provenance": result.test.provenance,
        "share": "of the answers that preferred the contour after bootstrapping; low, high: 95 % interval",
        "overall": plain(result.overall),
        "speakers": {name: plain(share) for name, share in result.speakers},
        "scans": [
            {"speaker": scan.speaker, "phone": scan.phone, **plain(scan.share)} for scan in result.scans
        ],
        "initial_won": [[scan.speaker, scan.phone] for scan in result.initial_won],
        "participants": [
            {
                "name": who.name,
                "partition": who.partition,
                "answered": who.answered,
                "total": who.total,
                "left": who.left,
                "damaged_lines": who.damaged,
                **plain(who.share),
            }
            for who in result.participants
        ],
    }


def write_tally(result: Tally, folder: Path) -> list[Path]:
    """Writes the TALLY_FILES into the folder; returns where they are."""
    library("matplotlib.figure", "plot")
    scans = _table(
        ["speaker", "phone", "answers", FINAL, INITIAL, "share", "low", "high", "initial_won"],
        (
            [
                scan.speaker, scan.phone, scan.share.count, scan.share.final, scan.share.count - scan.share.final,
                *(f"{value:.4f}" if scan.share.count else "" for value in _numbers(scan.share)), int(scan.initial_won),
            ]
            for scan in result.scans
        ),
    )  # fmt: skip
    answers = _table(
        ["participant", "partition", "place", "speaker", "phone", "at_mm", "side", "chosen"],
        (
            [
                answer.participant, answer.partition, answer.place, answer.speaker, answer.phone, answer.at_mm,
                SIDES[answer.chosen != answer.left], answer.chosen,
            ]
            for answer in result.answers
        ),
    )  # fmt: skip
    numbers = json.dumps(as_json(result), ensure_ascii=False, indent=1, allow_nan=False)
    figure = draw_scans(result)
    pictures = []
    for kind in ("png", "svg"):
        stream = io.BytesIO()
        figure.savefig(stream, format=kind, dpi=130)
        pictures.append(stream.getvalue())
    contents = (
        numbers.encode(),
        scans.encode(),
        answers.encode(),
        f"{as_text(result)}\n".encode(),
        *pictures,
    )
    return [
        write_atomically(folder / name, content) for name, content in zip(TALLY_FILES, contents, strict=True)
    ]


def draw_scans(result: Tally) -> Figure:
    """The paper's figure: for every scan the answers for either method, grouped by speaker."""
    figures = library("matplotlib.figure", "plot")
    phones = list(dict.fromkeys(scan.phone for scan in result.scans))
    columns = min(COLUMNS, len(result.speakers))
    rows = math.ceil(len(result.speakers) / columns)
    figure: Figure = figures.Figure(
        figsize=(0.8 + columns * (0.6 + 0.19 * len(phones)), 1.0 + 1.55 * rows), layout="constrained"
    )
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for panel in panels[len(result.speakers) :]:
        panel.set_visible(False)
    for index, (name, share) in enumerate(result.speakers):
        panel = panels[index]
        own = {scan.phone: scan.share for scan in result.scans if scan.speaker == name}
        for place, phone in enumerate(phones):
            found = own.get(phone)
            if found is None or not found.count:
                panel.text(place, 0.5, "no scan" if found is None else "not judged", rotation=90, size=6.5, color="0.4",
                           ha="center", va="center", bbox={"facecolor": "white", "linewidth": 0, "pad": 1})  # fmt: skip
                continue
            panel.bar(place, found.share, 0.78, color=FOR_FINAL)
            panel.bar(place, 1 - found.share, 0.78, found.share, color=FOR_INITIAL)
        panel.axhline(0.5, color="0.15", linewidth=0.8, linestyle=(0, (4, 3)))
        panel.set_title(f"{name}: {_percent(share.share)} %" if share.count else name, size=9)
        panel.set_xticks(range(len(phones)), phones, size=8)
        panel.tick_params(axis="x", length=0)
        panel.set(xlim=(-0.6, len(phones) - 0.4), ylim=(0, 1), yticks=[0, 0.5, 1])
        panel.set_yticklabels(["0 %", "50 %", "100 %"], size=8)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    patches = library("matplotlib.patches", "plot")
    figure.legend(
        handles=[
            patches.Patch(color=FOR_FINAL, label="for the contour after bootstrapping"),
            patches.Patch(color=FOR_INITIAL, label="for the contour after the first matching"),
        ],
        loc="outside lower center", ncols=2, fontsize=8, frameon=False,
    )  # fmt: skip
    overall = result.overall
    figure.suptitle(
        f"{result.test.source}{_made_up(result)}\n"
        f"bootstrapping preferred in {_percent(overall.share)} % of {overall.count} answers ({_interval(overall)} %)",
        size=10,
    )
    return figure


def _made_up(result: Tally) -> str:
    return "; synthetic" if result.test.synthetic else ""


def _numbers(share: Share) -> tuple[float, float, float]:
    return share.share, share.low, share.high


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.1f}"


def _interval(share: Share) -> str:
    return f"{_percent(share.low)} to {_percent(share.high)}" if share.count else "–"


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(header)
    table.writerows(rows)
    return out.getvalue()
