"""Scans: one world whatever the file and its axes, crop and 8 bit, and one sentence for what cannot be used."""

from __future__ import annotations

import gzip
import io
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.model.mri.reading import take_values
from tonguetrack.model.mri.scan import Scan, read_scan, scan_of, write_nifti

nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")
pydicom = pytest.importorskip("pydicom")

SHAPE = (4, 5, 6)
SPACING = np.array([1.2, 1.1875, 0.9])
CENTRE = np.array([3.0, 40.0, -7.0])
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def brightness(points: np.ndarray) -> np.ndarray:
    """What is at a place of the world, mm; different along every axis, and linear, so that it survives trilinear."""
    return np.rint(100 * (points - CENTRE) @ [3.0, -5.0, 7.0]) + 20000.0


def world(turn: np.ndarray, shape: tuple[int, ...] = SHAPE, spacing: np.ndarray = SPACING) -> np.ndarray:
    """A grid about CENTRE whose axes i, j, k are the columns of `turn`."""
    matrix = np.eye(4)
    matrix[:3, :3] = turn * spacing
    matrix[:3, 3] = CENTRE - matrix[:3, :3] @ ((np.array(shape) - 1) / 2)
    return matrix


def filled(matrix: np.ndarray, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    places = np.indices(shape).reshape(3, -1).T @ matrix[:3, :3].T + matrix[:3, 3]
    return brightness(places).reshape(shape)


def all_turns() -> list[np.ndarray]:
    """The 48 orders and directions that the axes of a straight grid can have."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[list(order), range(3)] = signs
            turns.append(turn)
    return turns


OBLIQUE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()


def assert_same_world(scan: Scan) -> None:
    """Every voxel's centre is where its brightness says."""
    places = scan.points(np.indices(scan.values.shape).reshape(3, -1).T)
    np.testing.assert_allclose(scan.values.ravel(), brightness(places), atol=1.01)
    np.testing.assert_allclose(sorted(scan.spacing_mm), sorted(SPACING), rtol=1e-5)
    probes = CENTRE + np.random.default_rng(1).uniform(-1.5, 1.5, size=(40, 3))
    np.testing.assert_allclose(scan.at(probes), brightness(probes), atol=2.5)


# One world ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
def test_a_nifti_volume_in_every_orientation_shows_the_same_at_the_same_place(tmp_path, ending):
    path = tmp_path / f"scan{ending}"
    for turn in [*all_turns(), OBLIQUE, OBLIQUE @ np.diag([1, -1, 1])]:
        matrix = world(turn)
        nibabel.save(nibabel.Nifti1Image(filled(matrix).astype(np.float32), RAS @ matrix), path)
        assert_same_world(read_scan(path))


@pytest.mark.parametrize(
    ("space", "flip"),
    [("left-posterior-superior", (1, 1, 1)), ("RAS", (-1, -1, 1)), ("left-anterior-superior", (1, -1, 1))],
)
def test_an_nrrd_volume_in_every_orientation_and_space_shows_the_same_at_the_same_place(
    tmp_path, space, flip
):
    path = tmp_path / "scan.nrrd"
    for turn in [*all_turns(), OBLIQUE]:
        matrix = world(turn)
        stored = np.diag([*flip, 1.0]) @ matrix
        header = {"space": space, "space directions": stored[:3, :3].T, "space origin": stored[:3, 3]}
        nrrd.write(str(path), filled(matrix).astype(np.float32), {**header, "encoding": "raw"})
        assert_same_world(read_scan(path))


def write_series(folder: Path, matrix: np.ndarray, values: np.ndarray, **changes: object) -> list[Path]:
    """One file a slice along k, in no order; `values` as whole numbers, (columns, rows, slices)."""
    folder.mkdir(exist_ok=True)
    uids = [pydicom.uid.generate_uid(entropy_srcs=[f"{folder}{number}"]) for number in range(2)]
    files = []
    for number in range(values.shape[2]):
        meta = pydicom.dataset.FileMetaDataset()
        meta.MediaStorageSOPClassUID = pydicom.uid.MRImageStorage
        meta.MediaStorageSOPInstanceUID = pydicom.uid.generate_uid(entropy_srcs=[str(number)])
        meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
        data = pydicom.dataset.FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
        data.SOPClassUID, data.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
        data.SeriesInstanceUID, data.SeriesDescription, data.Modality = uids[0], "t1", "MR"
        data.Columns, data.Rows = values.shape[:2]
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        data.ImageOrientationPatient = [f"{x:.9g}" for x in (matrix[:3, :2] / lengths[:2]).T.ravel()]
        data.PixelSpacing = [f"{lengths[1]:.9g}", f"{lengths[0]:.9g}"]  # between rows, then between columns
        data.ImagePositionPatient = [f"{x:.9g}" for x in matrix[:3, 3] + number * matrix[:3, 2]]
        data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
        data.BitsAllocated = data.BitsStored = 16
        data.HighBit, data.PixelRepresentation = 15, 0
        data.PixelData = values[:, :, number].T.astype("<u2").tobytes()
        for key, value in changes.items():
            setattr(data, key, value)
        file = folder / f"IM{(number * 7 + 3) % 101:03d}"
        data.save_as(file, enforce_file_format=True)
        files.append(file)
    return files


def test_a_dicom_series_in_every_orientation_shows_the_same_at_the_same_place(tmp_path):
    for number, turn in enumerate([*all_turns(), OBLIQUE]):
        matrix = world(turn)
        folder = tmp_path / f"series{number}"
        write_series(folder, matrix, filled(matrix))
        (folder / "notes.txt").write_text("passed over")
        assert_same_world(read_scan(folder))


def test_what_is_written_as_nifti_is_read_back(tmp_path):
    random = np.random.default_rng(2)
    for values in (random.normal(size=SHAPE), random.integers(0, 255, SHAPE).astype(np.uint8)):
        for ending in (".nii", ".nii.gz"):
            scan = scan_of(values, world(OBLIQUE), "made")
            write_nifti(scan, tmp_path / f"scan{ending}")
            back = read_scan(tmp_path / f"scan{ending}")
            np.testing.assert_array_equal(back.values, scan.values)
            assert back.values.dtype == scan.values.dtype
            np.testing.assert_allclose(back.to_world, scan.to_world, atol=1e-5)
    with pytest.raises(InputError, match=r"scan\.mhd: scans are written as \.nii or"):
        write_nifti(scan, tmp_path / "scan.mhd")


def test_the_same_scan_gives_the_same_bytes(tmp_path):
    scan = scan_of(np.arange(24.0).reshape(2, 3, 4), world(np.eye(3)), "made")
    for name in ("a.nii.gz", "b.nii.gz"):
        write_nifti(scan, tmp_path / name)
    assert (tmp_path / "a.nii.gz").read_bytes() == (tmp_path / "b.nii.gz").read_bytes()


# What a header may also say -------------------------------------------------------------------------


def test_nifti_scale_unit_byte_order_and_second_version_are_respected(tmp_path):
    matrix = world(np.eye(3))
    values = filled(matrix)
    path = tmp_path / "scan.nii"
    image = nibabel.Nifti1Image(((values - 7) / 4).astype(np.int16), RAS @ matrix)
    image.header.set_slope_inter(4, 7)
    nibabel.save(image, path)
    np.testing.assert_allclose(read_scan(path).values, values, atol=4)

    big = nibabel.Nifti1Header(endianness=">")
    nibabel.save(nibabel.Nifti1Image(values.astype(">f4"), RAS @ matrix, big), path)
    assert int.from_bytes(path.read_bytes()[:4], "big") == 348
    assert_same_world(read_scan(path))

    nibabel.save(nibabel.Nifti2Image(values[..., None].astype(np.float64), RAS @ matrix), path)
    assert_same_world(read_scan(path))

    in_micrometres = RAS @ matrix
    in_micrometres[:3] *= 1000
    image = nibabel.Nifti1Image(values.astype(np.float32), in_micrometres)
    image.header.set_xyzt_units("micron")
    nibabel.save(image, path)
    assert_same_world(read_scan(path))


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2"])
@pytest.mark.parametrize("ending", [".nrrd", ".nhdr"])
def test_nrrd_values_may_be_packed_and_in_a_file_of_their_own(tmp_path, encoding, ending):
    matrix = world(np.eye(3))
    header = {"space": "LPS", "space directions": matrix[:3, :3].T, "space origin": matrix[:3, 3]}
    nrrd.write(
        str(tmp_path / f"scan{ending}"), filled(matrix).astype(">i4"), {**header, "encoding": encoding}
    )
    assert_same_world(read_scan(tmp_path / f"scan{ending}"))


def test_bytes_and_lines_before_the_values_of_an_nrrd_are_skipped(tmp_path):
    matrix = world(np.eye(3))
    values = filled(matrix).astype("<f4").tobytes(order="F")
    steps = " ".join(f"({','.join(map(str, row))})" for row in matrix[:3, :3].T)
    start = f"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 5 6\nspace: LPS\nspace directions: {steps}\nendian: little\n"
    start += f"space origin: ({','.join(map(str, matrix[:3, 3]))})\nencoding: raw\ndata file: values.bin\n"
    for skips, before in (
        ("line skip: 1\nbyte skip: 3\n", b"some line\nabc"),
        ("byteskip: -1\n", b"whatever"),
    ):
        (tmp_path / "scan.nhdr").write_text(start + skips)
        (tmp_path / "values.bin").write_bytes(before + values)
        assert_same_world(read_scan(tmp_path / "scan.nhdr"))


def test_dicom_values_are_rescaled(tmp_path):
    matrix = world(np.eye(3))
    write_series(
        tmp_path / "s", matrix, (filled(matrix) + 1000) // 4, RescaleSlope="4", RescaleIntercept="-1000"
    )
    np.testing.assert_allclose(read_scan(tmp_path / "s").values, filled(matrix), atol=4)


# Region, 8 bit, sampling ----------------------------------------------------------------------------


@given(st.integers(0, 47), st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
def test_a_region_in_mm_keeps_exactly_the_voxels_whose_centres_are_in_it(turn, numbers):
    scan = scan_of(filled(world(all_turns()[turn])), world(all_turns()[turn]), "made")
    corners = CENTRE + np.sort(np.array(numbers).reshape(2, 3), axis=0)
    places = scan.points(np.indices(SHAPE).reshape(3, -1).T)
    inside = ((places >= corners[0] - 1e-6) & (places <= corners[1] + 1e-6)).all(axis=1)
    try:
        part = scan.cropped(*corners)
    except InputError as reason:
        kept = np.argwhere(inside.reshape(SHAPE))
        assert not len(kept) or np.ptp(kept, axis=0).min() < 1
        assert "region of interest" in str(reason)
        return
    assert part.values.size == inside.sum()
    assert_same_places(part, scan)


def assert_same_places(part: Scan, whole: Scan) -> None:
    places = part.points(np.indices(part.values.shape).reshape(3, -1).T)
    np.testing.assert_allclose(part.values.ravel(), whole.at(places), atol=1e-2)


def test_a_region_in_voxels_counts_from_the_first_up_to_but_without_the_last():
    scan = scan_of(filled(world(OBLIQUE)), world(OBLIQUE), "made")
    part = scan.cropped_voxels((1, 0, 2), (3, 5, 6))
    np.testing.assert_array_equal(part.values, scan.values[1:3, :, 2:6])
    assert_same_places(part, scan)
    for first, behind in [
        ((0, 0, 0), (9, 5, 6)),
        ((-1, 0, 0), (4, 5, 6)),
        ((2, 2, 2), (2, 4, 4)),
        ((0, 0), (4, 5)),
    ]:
        with pytest.raises(InputError, match="made: the region of interest"):
            scan.cropped_voxels(first, behind)


def test_on_an_oblique_grid_a_region_in_mm_loses_no_voxel_of_the_box():
    scan = scan_of(filled(world(OBLIQUE, (20, 20, 20)), (20, 20, 20)), world(OBLIQUE, (20, 20, 20)), "made")
    part = scan.cropped(CENTRE - 3, CENTRE + 3)
    assert part.values.size < scan.values.size
    assert_same_places(part, scan)
    both = [s.points(np.indices(s.values.shape).reshape(3, -1).T) for s in (scan, part)]
    inside = [(np.abs(places - CENTRE) < 3).all(axis=1).sum() for places in both]
    assert inside[0] == inside[1] > 100


def test_eight_bits_span_all_but_the_most_extreme_thousandths():
    values = np.random.default_rng(3).uniform(100, 300, size=(30, 30, 30))
    values[0, 0, 0], values[1, 1, 1] = -5000, 90000  # one dead and one glaring voxel
    grey = scan_of(values, world(np.eye(3)), "made").quantised().values
    assert grey.dtype == np.uint8 and grey[0, 0, 0] == 0 and grey[1, 1, 1] == 255
    within = (values > 101) & (values < 299)
    np.testing.assert_allclose(grey[within], (values[within] - 100) / 200 * 255, atol=1.5)


def test_eight_bits_of_a_picture_with_hardly_anything_on_it_still_show_it():
    values = np.zeros((30, 30, 30))
    values[3, 3, 3] = 5.0
    assert scan_of(values, world(np.eye(3)), "made").quantised().values[3, 3, 3] == 255
    with pytest.raises(InputError, match="made: all voxels have the same value"):
        scan_of(np.full((3, 3, 3), 7.0), world(np.eye(3)), "made").quantised()


def test_outside_of_the_grid_the_nearest_edge_is_seen():
    scan = scan_of(np.arange(27.0).reshape(3, 3, 3), np.eye(4), "made")
    np.testing.assert_array_equal(scan.at([[-9, 1, 1], [9, 9, 9], [1, 1, 99], [1, 1, 1]]), [4, 26, 14, 13])


# What cannot be used --------------------------------------------------------------------------------


def refused(path: Path, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        read_scan(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_volume_that_promises_too_much_is_refused_before_it_is_read(tmp_path):
    header = nibabel.Nifti1Header()
    header.set_data_shape((10000, 10000, 10000))
    header.set_sform(np.eye(4), code=1)
    header["vox_offset"], header["magic"] = 352, b"n+1"
    content = header.binaryblock + bytes(1000)
    (tmp_path / "big.nii").write_bytes(content)
    (tmp_path / "big.nii.gz").write_bytes(gzip.compress(content))
    refused(tmp_path / "big.nii", "promises 10000 x 10000 x 10000 voxels")
    refused(tmp_path / "big.nii.gz", "promises 10000 x 10000 x 10000 voxels")

    text = "NRRD0004\ntype: short\ndimension: 3\nsizes: 10000 10000 10000\nencoding: gzip\nendian: little\n\n"
    (tmp_path / "big.nrrd").write_text(text)
    refused(tmp_path / "big.nrrd", "promises 10000 x 10000 x 10000 voxels")

    matrix = world(np.eye(3))
    write_series(tmp_path / "big", matrix, filled(matrix), Rows=65535, Columns=65535)
    refused(tmp_path / "big", "promises 65535 x 65535 x 2 voxels")


def test_no_more_is_unpacked_than_the_header_says():
    class Endless(io.RawIOBase):
        asked = 0

        def read(self, size: int = -1) -> bytes:
            assert size >= 0
            self.asked += size
            return bytes(size)

    stream = Endless()
    assert take_values(stream, (2, 3, 4), np.dtype("<f4")).shape == (2, 3, 4)
    assert stream.asked == 97


def sound_files(folder: Path) -> list[Path]:
    """The same volume in every format, 4 x 5 x 6 voxels."""
    matrix = world(np.eye(3))
    scan = scan_of(filled(matrix), matrix, "made")
    write_nifti(scan, folder / "scan.nii")
    write_nifti(scan, folder / "scan.nii.gz")
    header = {"space": "LPS", "space directions": matrix[:3, :3].T, "space origin": matrix[:3, 3]}
    for name, encoding in (("raw.nrrd", "raw"), ("packed.nrrd", "gzip")):
        nrrd.write(str(folder / name), scan.values, {**header, "encoding": encoding})
    return [folder / name for name in ("scan.nii", "scan.nii.gz", "raw.nrrd", "packed.nrrd")]


def test_a_file_cut_short_anywhere_is_refused_with_one_sentence(tmp_path):
    for file in sound_files(tmp_path):
        content = file.read_bytes()
        short = tmp_path / f"short_{file.name}"
        for length in [*range(0, len(content) - 9, 37), len(content) - 9]:
            short.write_bytes(content[:length])
            refused(short, "short_")


def test_a_series_with_a_slice_cut_short_anywhere_is_refused_with_one_sentence(tmp_path):
    matrix = world(np.eye(3))
    file = write_series(tmp_path / "s", matrix, filled(matrix))[2]
    content = file.read_bytes()
    for length in [*range(140, len(content) - 1, 61), len(content) - 1]:
        file.write_bytes(content[:length])
        refused(tmp_path / "s", file.name)


def test_whatever_is_wrong_in_a_file_there_is_a_scan_or_one_sentence(tmp_path):
    random = np.random.default_rng(4)
    matrix = world(np.eye(3))
    series = write_series(tmp_path / "s", matrix, filled(matrix))[0]
    for file, scan in [*((file, file) for file in sound_files(tmp_path)), (series, tmp_path / "s")]:
        sound = file.read_bytes()
        for _ in range(150):
            content = bytearray(sound)
            for place in random.integers(0, min(len(content), 900), size=random.integers(1, 4)):
                content[place] = random.integers(0, 256)
            file.write_bytes(content)
            try:
                read = read_scan(scan)
            except InputError as reason:
                assert str(reason).startswith(str(scan)) and "\n" not in str(reason)
            else:
                assert np.isfinite(read.values).all()
        file.write_bytes(sound)
        read_scan(scan)


def test_what_is_no_scan_is_said(tmp_path):
    refused(tmp_path / "nothing.nii", "there is no such scan")
    (tmp_path / "scan.mhd").write_text("x")
    refused(
        tmp_path / "scan.mhd", r"a scan is a file ending in \.nii, \.nii\.gz, \.nrrd, \.nhdr, or the folder"
    )
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "notes.txt").write_text("x")
    refused(tmp_path / "folder", "holds no DICOM files")


def nifti(tmp_path: Path, values: np.ndarray, affine: np.ndarray, oriented: bool = True) -> Path:
    content = bytearray(nibabel.Nifti1Image(values, affine).to_bytes())
    if not oriented:
        content[252:256] = bytes(4)  # qform_code and sform_code
    (tmp_path / "scan.nii").write_bytes(content)
    return tmp_path / "scan.nii"


def test_a_nifti_without_orientation_or_that_is_no_volume_is_refused(tmp_path):
    values = np.ones(SHAPE, np.float32)
    refused(nifti(tmp_path, values, np.eye(4), oriented=False), "states no orientation")
    refused(
        nifti(tmp_path, np.ones((4, 5), np.float32), np.eye(4)), "holds 4 x 5 values; expected one volume"
    )
    refused(nifti(tmp_path, np.ones((4, 5, 6, 2), np.float32), np.eye(4)), "holds 4 x 5 x 6 x 2 values")
    refused(nifti(tmp_path, values.astype(np.complex64), np.eye(4)), "of the type 'complex64'")
    sheared = np.eye(4)
    sheared[0, 1] = 0.2
    refused(nifti(tmp_path, values, sheared), "not at right angles")
    refused(nifti(tmp_path, values, np.diag([1000.0, 1000, 1000, 1])), "1e[+]03 x 1e[+]03 x 1e[+]03 mm large")
    values[1, 2, 3] = np.nan
    refused(nifti(tmp_path, values, np.eye(4)), "1 voxels are no finite numbers")
    pair = nibabel.Nifti1Pair(values, np.eye(4))
    nibabel.save(pair, tmp_path / "pair.img")
    (tmp_path / "pair.hdr").rename(tmp_path / "pair.nii")
    refused(tmp_path / "pair.nii", "only the header of a volume|cut short")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("space: left-posterior-superior", "space: scanner-xyz", "the space 'scanner-xyz'"),
        ("space: left-posterior-superior\n", "", "states no space"),
        ("encoding: raw", "encoding: hex", "encoded as 'hex'"),
        ("type: float", "type: block", "of the type 'block'"),
        ("endian: little\n", "", "lacks 'endian'"),
        ("encoding: raw", 'encoding: raw\nspace units: "cm" "cm" "cm"', "measured in cm; expected mm"),
        ("encoding: raw", "encoding: raw\nbyte skip: -7", "skip 0 lines and -7 bytes"),
        ("encoding: raw", "encoding: raw\ndata file: gone.raw", "'gone.raw', which is not there"),
        ("NRRD", "NRRE", "does not begin with a NRRD header"),
    ],
)
def test_an_nrrd_that_cannot_be_placed_or_read_is_refused(tmp_path, old, new, match):
    matrix = world(np.eye(3))
    header = {"space": "left-posterior-superior", "space directions": matrix[:3, :3].T}
    nrrd.write(str(tmp_path / "scan.nrrd"), filled(matrix).astype(np.float32), {**header, "encoding": "raw"})
    content = (tmp_path / "scan.nrrd").read_bytes()
    assert old.encode() in content
    (tmp_path / "scan.nrrd").write_bytes(content.replace(old.encode(), new.encode(), 1))
    refused(tmp_path / "scan.nrrd", match)


def changed(file: Path, **changes: object) -> None:
    data = pydicom.dcmread(file)
    for key, value in changes.items():
        setattr(data, key, value)
    data.save_as(file)


def test_a_series_with_a_gap_a_double_or_a_foreign_slice_is_refused(tmp_path):
    matrix = world(np.eye(3))
    folder = tmp_path / "s"

    def fresh() -> list[Path]:
        for file in folder.glob("*"):
            file.unlink()
        return write_series(folder, matrix, filled(matrix))

    fresh()
    assert_same_world(read_scan(folder))
    fresh()[2].unlink()
    refused(folder, r"between IM010 and IM024 lie 1\.80 mm, elsewhere 0\.90 mm; slices are missing")
    (folder / "twice").write_bytes(fresh()[3].read_bytes())
    refused(
        folder, "IM024 and twice are slices at the same place|twice and IM024 are slices at the same place"
    )
    changed(fresh()[1], SeriesInstanceUID="1.2.3", SeriesDescription="localiser")
    refused(folder, r"mixes 2 series \('.*', '.*'\); give each a folder of its own")
    changed(fresh()[1], PixelSpacing=["2", "2"])
    refused(folder, "IM010 has another size, direction or pixel spacing than")
    changed(fresh()[1], NumberOfFrames=2)
    refused(folder, "IM010 holds several frames or colours")
    data = pydicom.dcmread(fresh()[1])
    del data.ImagePositionPatient
    data.save_as(folder / "IM010")
    refused(folder, "IM010 is no readable slice of a volume")
    for number, file in enumerate(fresh()):
        place = matrix[:3, 3] + number * (matrix[:3, 2] + [0.0, 0.3, 0.0])
        changed(file, ImagePositionPatient=[f"{x:.9g}" for x in place])
    refused(folder, "tilted gantry")
    for file in fresh()[1:]:
        file.unlink()
    refused(folder, "holds 4 x 5 x 1 values; expected one volume")


@pytest.mark.parametrize("module", ["nibabel", "nrrd", "pydicom"])
def test_without_its_library_a_format_names_the_extra(tmp_path, monkeypatch, module):
    name = {"nibabel": "scan.nii", "nrrd": "scan.nrrd", "pydicom": "series"}[module]
    (tmp_path / name).mkdir() if module == "pydicom" else (tmp_path / name).write_bytes(b"x")
    monkeypatch.setitem(sys.modules, module, None)
    refused(
        tmp_path / name,
        rf"'{module}' is not installed: this needs the extra 'mri': pip install 'tonguetrack\[mri\]'",
    )
