"""From a data set of scans to a model of the tongue: all steps of the paper in their order.

    scans      each cropped, quantised, denoised, segmented; its surface as points with normals
    palates    of each speaker, in the scan that shows it: template matching, then again from a PCA model of all
    aligned    where its speaker's palate is in each scan
    clouds     of each scan, with the palate in place of the tongue's surface where they touch
    matched    the tongue template to each of these, from where the landmarks put it
    tongues    again, several rounds, each from a model of all tongues of the round before

What fails for one scan is left out, with a sentence that names it, and the rest goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from ... import InputError
from ...parallel import Executor, Failed, Progress
from . import stages, templates
from .bootstrapping import Cell, model_of
from .caching import Cache, Source, Step, Stored, run_step, source
from .dataset import Dataset, Problem, Region
from .palates import palate_model
from .results import Index, is_sound, motions_of, shapes_of, tongues_in_head
from .settings import BuildSettings, DenoisingSettings

Name = TypeVar("Name")
Watch = Callable[[str], AbstractContextManager[Progress | None]]
"""What is being done -> whom to tell how much of it is done, while it is."""


def unwatched(what: str) -> AbstractContextManager[Progress | None]:
    return nullcontext()


def build(
    dataset: Dataset,
    settings: BuildSettings,
    work: str | Path,
    executor: Executor,
    watch: Watch = unwatched,
    until: str = "tongues",
) -> Index:
    """Makes what the work folder does not keep already; the keys of everything that the result consists of.

    until: the last of STAGES to be taken. Raises InputError where nothing is left to go on with.
    """
    lately = _Making(Cache(Path(work).absolute()), executor, watch)
    index = Index(
        dataset.requiring_landmarks(templates.tongue().landmarks, templates.palate().landmarks), settings
    )
    for stage in list(STAGES)[: list(STAGES).index(until) + 1]:
        start_s = time.perf_counter()
        index = STAGES[stage](index, lately)
        index = replace(index, seconds={**index.seconds, stage: time.perf_counter() - start_s})
        if not index.dataset.scans:
            said = index.dataset.problems[0].sentence if index.dataset.problems else "it lists none"
            raise InputError(f"{dataset.source}: no scan is left to go on with: {said}")
    return index


@dataclass(frozen=True)
class _Making:
    """Where results are kept, who makes them, and who watches."""

    cache: Cache
    executor: Executor
    watch: Watch

    def made(
        self, what: str, step: Step, rows: Mapping[Name, Sequence[Any]]
    ) -> tuple[dict[Name, str], dict[Name, str]]:
        """The arguments of a result, by name -> keys of those that were made; sentences for those that were not."""
        with self.watch(what) as progress:
            outcomes = run_step(self.cache, step, list(rows.values()), self.executor, progress)
        keys, failures = {}, {}
        for name, outcome in zip(rows, outcomes, strict=True):
            if isinstance(outcome, Failed):
                failures[name] = outcome.reason
            else:
                keys[name] = outcome.key
        return keys, failures

    def of_scans(
        self, what: str, step: Step, rows: Mapping[Cell, Sequence[Any]], index: Index
    ) -> tuple[dict[Cell, str], Index]:
        """The same for scans; those that failed are left out of the data set."""
        keys, failures = self.made(what, step, rows)
        problems = [Problem(*cell, _sentence(cell, reason)) for cell, reason in failures.items()]
        return keys, replace(index, dataset=index.dataset.without(problems))

    def of_speakers(
        self, what: str, step: Step, rows: Mapping[str, Sequence[Any]], index: Index
    ) -> tuple[dict[str, str], Index]:
        """The same for the palates of speakers; who has none is left out with all scans."""
        keys, failures = self.made(what, step, rows)
        problems = [
            Problem(name, None, f"{name}: the palate cannot be extracted, all scans are left out: {reason}")
            for name, reason in failures.items()
        ]
        return keys, replace(index, dataset=index.dataset.without(problems))


# The stages --------------------------------------------------------------------------------------------


def _scans(index: Index, making: _Making) -> Index:
    digests, problems = {}, []
    for cell, entry in index.dataset.scans.items():
        try:
            digests[cell] = source(entry.path).digest
        except InputError as reason:
            problems.append(Problem(*cell, _sentence(cell, str(reason))))
    index = replace(index, dataset=index.dataset.without(problems), digests=digests)
    rows = {cell: (*_file(index, cell), _denoising(index)) for cell in index.dataset.scans}
    surfaces, index = making.of_scans("surfaces of the scans", stages.SURFACE, rows, index)
    return replace(index, surfaces=surfaces)


def _palates(index: Index, making: _Making) -> Index:
    settings, template = index.settings, templates.palate()
    marked = {
        name: index.dataset.scans[name, index.dataset.palate_phone[name]].palate_landmarks
        for name in index.dataset.speakers
    }
    rows: dict[str, tuple[Any, ...]] = {
        name: (
            *_file(index, (name, index.dataset.palate_phone[name])),
            _denoising(index),
            template,
            marked[name],
        )
        for name in index.dataset.speakers
    }
    clouds, index = making.of_speakers("surfaces of the palates", stages.PALATE_SURFACE, rows, index)
    rows = {
        name: (Stored(clouds[name]), template, marked[name], settings.palate)
        for name in index.dataset.speakers
    }
    keys, index = making.of_speakers("palates matched", stages.PALATE, rows, index)
    for number in range(1, settings.palate_prior.rounds + 1):
        if len(index.dataset.speakers) < 2:
            break  # a single palate has nothing to learn from
        known = {name: making.cache.load(keys[name])["vertices"] for name in index.dataset.speakers}
        model = palate_model(known, template)
        rows = {
            name: (
                Stored(clouds[name]),
                template,
                marked[name],
                settings.palate,
                model,
                settings.palate_prior,
                Stored(keys[name]),
            )
            for name in index.dataset.speakers
        }
        what = f"palates matched again, round {number} of {settings.palate_prior.rounds}"
        keys, index = making.of_speakers(what, stages.PALATE_AGAIN, rows, index)
    return replace(index, palates=keys)


def _aligned(index: Index, making: _Making) -> Index:
    rows = {}
    for cell in index.dataset.scans:
        speaker = cell[0]
        own = speaker, index.dataset.palate_phone[speaker]
        palate = Stored(index.palates[speaker])
        rows[cell] = (
            palate,
            templates.palate(),
            *_file(index, own),
            *_file(index, cell),
            index.settings.alignment,
        )
    aligned, index = making.of_scans("palates brought to all scans", stages.ALIGNED, rows, index)
    return replace(index, aligned=aligned)


def _clouds(index: Index, making: _Making) -> Index:
    if not index.settings.restore_contact:
        return replace(index, clouds=index.surfaces)
    rows = {
        cell: (
            Stored(index.surfaces[cell]),
            Stored(index.aligned[cell]),
            templates.palate(),
            index.settings.contact,
        )
        for cell in index.dataset.scans
    }
    clouds, index = making.of_scans("contact restored", stages.RESTORED, rows, index)
    return replace(index, clouds=clouds)


def _matched(index: Index, making: _Making) -> Index:
    rows = {
        cell: (
            Stored(index.clouds[cell]),
            templates.tongue(),
            entry.tongue_landmarks,
            index.settings.tongue,
        )
        for cell, entry in index.dataset.scans.items()
    }
    keys, index = making.of_scans("tongues matched", stages.MATCHED, rows, index)
    return _with_tongues(replace(index, tongues={cell: (key,) for cell, key in keys.items()}), making)


def _bootstrapped(index: Index, making: _Making) -> Index:
    prior = index.settings.tongue_prior
    for number in range(1, index.settings.rounds + 1):
        motions = motions_of(index, making.cache)
        tongues = tongues_in_head(index, making.cache, motions)
        model = model_of(shapes_of(index, tongues), prior.speaker_modes, prior.pose_modes)
        rows = {
            cell: (
                Stored(index.clouds[cell]),
                templates.tongue(),
                entry.tongue_landmarks,
                index.settings.tongue,
                model,
                motions[cell],
                prior,
                Stored(index.tongues[cell][-1]),
            )
            for cell, entry in index.dataset.scans.items()
        }
        what = f"tongues matched again, round {number} of {index.settings.rounds}"
        keys, index = making.of_scans(what, stages.REMATCHED, rows, index)
        before = index.tongues
        index = replace(index, tongues={cell: (*before[cell], key) for cell, key in keys.items()})
        index = _with_tongues(index, making)
    return _finished(index, making)


def _finished(index: Index, making: _Making) -> Index:
    """With a problem for every mesh, speaker and phone that is not part of the model, and the errors of completing."""
    dataset = index.dataset
    problems = [
        Problem(
            *cell, _sentence(cell, "its mesh has faces that are turned over, and is not part of the model.")
        )
        for cell in dataset.scans
        if cell not in index.used
    ]
    shapes = shapes_of(index, tongues_in_head(index, making.cache, motions_of(index, making.cache)))
    problems += [
        Problem(
            name, None, f"{name}: no tongue of this speaker is left; the model does not know this speaker."
        )
        for name in dataset.speakers
        if name not in shapes.speakers
    ]
    problems += [
        Problem("", phone, f"[{phone}]: no tongue that holds this phone is left; the model does not know it.")
        for phone in dataset.phones
        if phone not in shapes.prompts
    ]
    held_out, _ = making.made("missing cells", stages.HELD_OUT, {"": (shapes.tensor, shapes.measured)})
    return replace(
        index,
        dataset=replace(dataset, problems=(*dataset.problems, *problems)),
        held_out=held_out.get(""),
    )


def _with_tongues(index: Index, making: _Making) -> Index:
    """Which of the tongues are meshes that a model may learn from."""
    faces = len(templates.tongue().mesh.faces)
    used = tuple(
        cell
        for cell in index.dataset.scans
        if is_sound(int(making.cache.load(index.tongues[cell][-1])["flipped"]), faces)
    )
    return replace(index, used=used)


def _file(index: Index, cell: Cell) -> tuple[Source, Region | None]:
    entry = index.dataset.scans[cell]
    return Source(entry.path.absolute(), index.digests[cell]), entry.region


def _denoising(index: Index) -> DenoisingSettings | None:
    return index.settings.denoising if index.settings.denoise else None


def _sentence(cell: Cell, reason: str) -> str:
    speaker, phone = cell
    return f"{speaker} [{phone}]: {reason}"


STAGES: Mapping[str, Callable[[Index, _Making], Index]] = {
    "scans": _scans,
    "palates": _palates,
    "aligned": _aligned,
    "clouds": _clouds,
    "matched": _matched,
    "tongues": _bootstrapped,
}
"""In their order; each adds its part to what the index tells."""
