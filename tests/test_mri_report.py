"""The report of a build shows every scan with what was found in it, what looks wrong first, and keeps every number."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import Browser
from displays import require_chromium
from madebuild import CELLS, COLUMNS, FINAL_MM, SENTENCE, SPEAKERS, TONGUE, Made, grid_mesh, made_build
from PIL import Image
from scipy.ndimage import map_coordinates

from tonguetrack import InputError
from tonguetrack.model.mesh import Mesh
from tonguetrack.model.mri.qualityreport import slices, write_report
from tonguetrack.model.mri.scan import scan_of
from tonguetrack.model.mri.slicesheet import sheet_of
from tonguetrack.model.mri.truthcomparison import TruthComparison, compare
from tonguetrack.parallel import local

ORDER = [CELLS[2], CELLS[1], CELLS[0]]  # what looks wrong first


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    return made_build(tmp_path_factory.mktemp("made") / "set")


@pytest.fixture(scope="module")
def comparison(made) -> TruthComparison:
    with local(1) as executor:
        return compare(made.result, made.dataset, executor)


@pytest.fixture(scope="module")
def page(made, comparison, tmp_path_factory) -> Path:
    return written(tmp_path_factory.mktemp("report") / "report", made.result, comparison)


def written(folder, result, comparison=None, ablations=None, jobs=1) -> Path:
    with local(jobs) as executor:
        return write_report(folder, result, executor, comparison, ablations)


class Elements(HTMLParser):
    """Every element of a page with its attributes, and everything that is shown as text."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.found: list[tuple[str, dict]] = []
        self.text = ""
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.found[-1][0] != "style":
            self.text += data

    def of(self, tag: str) -> list[dict]:
        return [attributes for name, attributes in self.found if name == tag]


# The page ------------------------------------------------------------------------------------------


def test_scans_are_shown_with_what_looks_wrong_first(page):
    text = Elements(page).text
    places = [text.rindex(f"{speaker} [{phone}]") for speaker, phone in ORDER]
    assert places == sorted(places)
    assert text.count("Its points are <far> away.") == 2 and SENTENCE in text


def test_the_page_needs_no_script_and_nothing_from_elsewhere(page):
    elements = Elements(page)
    assert not elements.of("script") and not elements.of("link")
    assert "http" not in page.read_text("utf-8") and "url(" not in page.read_text("utf-8")
    pictures = [image["src"] for image in elements.of("img")]
    assert len(pictures) == len(set(pictures)) == len(CELLS)
    for name in pictures:
        with Image.open(page.parent / name) as picture:
            picture.verify()


def test_names_that_look_like_markup_stay_names(page):
    elements = Elements(page)
    assert {tag for tag, _ in elements.found}.isdisjoint({"far"})
    assert f"{SPEAKERS[1]} [a]" in elements.text
    assert all(re.fullmatch(r"pictures/[\w.-]+\.jpg", image["src"]) for image in elements.of("img"))


def test_every_number_in_the_overview_leads_to_its_scan(page):
    elements = Elements(page)
    anchors = {article["id"] for article in elements.of("article")}
    links = {link["href"].lstrip("#") for link in elements.of("a")} - {"overview"}
    assert links == anchors and len(anchors) == len(CELLS)


def test_without_a_truth_nothing_is_said_of_one(made, tmp_path):
    page = written(tmp_path / "report", made.result)
    assert "truth" not in Elements(page).text and 'class="truth"' not in page.read_text("utf-8")
    assert "truth" not in json.loads((page.parent / "report.json").read_text("utf-8"))
    with open(page.parent / "scans.csv", newline="", encoding="utf-8") as file:
        assert not any("truth" in column for column in next(csv.reader(file)))


def test_ablations_are_lines_of_a_table(made, comparison, tmp_path):
    page = written(
        tmp_path / "report", made.result, comparison, {"everything": comparison, "less": comparison}
    )
    assert "What the steps bring" in Elements(page).text
    numbers = json.loads((page.parent / "report.json").read_text("utf-8"))
    assert list(numbers["ablations"]) == ["everything", "less"]


def test_a_scan_that_is_gone_is_named_and_the_others_are_drawn(made, tmp_path):
    cell = CELLS[0]
    entry = replace(made.dataset.scans[cell], path=tmp_path / "gone.nii.gz")
    scans = {**made.result.scans, cell: replace(made.result.scans[cell], entry=entry)}
    page = written(tmp_path / "report", replace(made.result, scans=scans))
    elements = Elements(page)
    assert len(elements.of("img")) == len(CELLS) - 1 and len(elements.of("article")) == len(CELLS)
    assert f"No picture: {tmp_path / 'gone.nii.gz'}: there is no such scan." in elements.text


def test_several_processes_write_the_same_report(made, page, comparison, tmp_path):
    again = written(tmp_path / "report", made.result, comparison, jobs=2)
    files = sorted(path.relative_to(page.parent) for path in page.parent.rglob("*") if path.is_file())
    assert len(files) == 3 + len(CELLS)
    for name in files:
        assert (again.parent / name).read_bytes() == (page.parent / name).read_bytes(), name


def test_a_place_that_is_a_file_is_one_sentence(made, tmp_path):
    (tmp_path / "report").write_text("in the way")
    with pytest.raises(InputError, match="report: this folder cannot be made"):
        written(tmp_path / "report", made.result)


# Numbers -------------------------------------------------------------------------------------------


def test_the_json_holds_every_scan_strictly(page, made, comparison):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    numbers = json.loads((page.parent / "report.json").read_text("utf-8"), parse_constant=refuse)
    assert [(scan["speaker"], scan["phone"]) for scan in numbers["scans"]] == ORDER
    for scan in numbers["scans"]:
        cell = scan["speaker"], scan["phone"]
        assert scan["truth"]["final"]["mean"] == pytest.approx(comparison.scans[cell].final.mean, abs=1e-6)
        assert scan["residual_mm"] == pytest.approx(made.result.scans[cell].residual_mm)
        assert (scan["truth"]["motion_mm"] is None) == (cell[1] == "a")
    assert numbers["problems"][0]["sentence"] == SENTENCE
    assert numbers["model"]["compactness"]["speaker"][-1] == 1.0


def test_the_csv_has_a_row_for_each_scan_with_the_numbers_of_the_json(page):
    numbers = json.loads((page.parent / "report.json").read_text("utf-8"))["scans"]
    with open(page.parent / "scans.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(numbers) and all(None not in row and None not in row.values() for row in rows)
    for row, scan in zip(rows, numbers, strict=True):
        assert (row["speaker"], row["phone"]) == (scan["speaker"], scan["phone"])
        assert float(row["first_residual_mm"]) == pytest.approx(scan["residual_mm"][0], abs=1e-4)
        assert float(row["last_residual_mm"]) == pytest.approx(scan["residual_mm"][-1], abs=1e-4)
        assert float(row["truth_final_mean_mm"]) == pytest.approx(scan["truth"]["final"]["mean"], abs=1e-4)
        assert (row["truth_motion_mm"] == "") == (scan["truth"]["motion_mm"] is None)
        assert float(row["moved_mm"]) > 0.0


# Pictures ------------------------------------------------------------------------------------------


def test_the_lines_lie_where_the_picture_turns_dark():
    """The true surface of a dome: bright a little below its line, dark a little above, in every slice."""
    low = np.array([-24.0, -2.0, -12.0])
    places = np.indices((32, 40, 24)).transpose(1, 2, 3, 0) * 1.5 + low
    height = 10.0 - (places[..., 0] / 16.0) ** 2 * 4.0 - ((places[..., 1] - 28.0) / 22.0) ** 2 * 8.0
    tissue = np.clip((height - places[..., 2]) / 1.5 + 0.5, 0.0, 1.0)
    to_world = np.diag([1.5, 1.5, 1.5, 1.0])
    to_world[:3, 3] = low
    scan = scan_of((200.0 * tissue).astype(np.float32), to_world, "dome").quantised()
    drawn = sheet_of(
        scan, {"final": TONGUE}, low, np.array([24.0, 56.0, 22.0]), slices(TONGUE.vertices[7::COLUMNS])
    )
    pixels = np.asarray(Image.open(io.BytesIO(drawn.picture))).astype(float)
    assert len(drawn.panels) == 5 and pixels.ndim == 2
    per_mm = np.array(pixels.shape) / [drawn.height_mm, drawn.width_mm]
    for panel in drawn.panels:
        (line,) = panel.lines["final"]
        assert panel.left_mm <= line[:, 0].min() and line[:, 0].max() <= panel.left_mm + panel.width_mm
        inner = line[2:-2]
        up, down = (
            map_coordinates(pixels, ((inner[:, ::-1] + [off, 0.0]) * per_mm - 0.5).T, order=1, mode="nearest")
            for off in (-2.0, 2.0)
        )
        at = map_coordinates(pixels, (inner[:, ::-1] * per_mm - 0.5).T, order=1, mode="nearest")
        assert (down > 220).all() and (up < 35).all() and 90 < np.median(at) < 165


def test_slices_go_through_the_middle_of_the_palate_and_beside_it():
    middle = np.stack([np.full(11, 3.0), np.linspace(10.0, 60.0, 11), np.zeros(11)], axis=1)
    assert slices(middle) == [
        ("sagittal", -6.0),
        ("sagittal", 3.0),
        ("sagittal", 12.0),
        ("coronal", 25.0),
        ("coronal", 45.0),
    ]


def test_surfaces_beside_the_scan_are_one_sentence_however_far_away():
    scan = scan_of(np.random.default_rng(0).uniform(size=(20, 20, 20)).astype(np.float32), np.eye(4), "cube")
    far = Mesh(TONGUE.vertices + 1e6, TONGUE.faces)
    with pytest.raises(InputError, match="beside the scan"):
        sheet_of(
            scan, {"final": far}, far.vertices.min(axis=0), far.vertices.max(axis=0), [("sagittal", 1e6)]
        )
    wide = np.array([1e7, 1e7, 1e7])
    drawn = sheet_of(scan, {"final": grid_mesh(lambda x, y: 9.0 + 0.0 * x)}, -wide, wide, [("sagittal", 5.0)])
    assert drawn.width_mm == drawn.height_mm == 19.0  # no more than there is of the scan


def test_in_a_browser_lines_lie_over_the_slices_and_can_be_hidden_without_a_script(page):
    with Browser(require_chromium()) as browser, browser.open(page.as_uri(), 1400, 2400) as tab:
        tab.wait("[...document.images].every(image => image.complete && image.naturalWidth > 500)")
        box = "(e => { const b = e.getBoundingClientRect(); return [b.x, b.y, b.width, b.height] })"
        image, drawing = (tab.run(f"{box}(document.querySelector('.sheet {tag}'))") for tag in ("img", "svg"))
        np.testing.assert_allclose(image, drawing, atol=0.5)
        shown = "getComputedStyle(document.querySelector('path.{}')).display"
        assert tab.run(shown.format("final")) != "none"
        tab.click("#show-final")
        assert tab.run(shown.format("final")) == "none" and tab.run(shown.format("initial")) != "none"
        # The final tongue is FINAL_MM above the true one, to scale.
        height = "document.querySelector('path.{}').getBBox().y"
        tab.click("#show-final")
        final, truth = (tab.run(height.format(name)) for name in ("final", "truth"))
        assert truth - final == pytest.approx(100 * FINAL_MM, abs=3.0)
        assert tab.run("document.documentElement.scrollWidth <= innerWidth") and not tab.complaints
