"""Pictures without a window: what is drawn lies where numpy says, and nothing is cut or lost."""

import dataclasses
import sys

import numpy as np
import pytest
from displays import require_egl

from tonguetrack import InputError
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.pose import CoilState, PoseStatus
from tonguetrack.tracker.session import Session
from tonguetrack.tracker.viewer import offscreen
from tonguetrack.tracker.viewer.camera import FIELD_DEG, home_view
from tonguetrack.tracker.viewer.look import DARK, LIGHT
from tonguetrack.tracker.viewer.offscreen import Offscreen, egl_context
from tonguetrack.tracker.viewer.overlay import LETTER
from tonguetrack.tracker.viewer.scene import Moment, scene_of
from tonguetrack.tracker.viewer.surface import Surface, SurfacePrograms

SIZE = (800, 600)
SIZES = [(640, 360), (800, 600), (1280, 720), (1920, 1080)]
POSES = [(0, 0, 0, 0), (1.5, -1.5, 1.0, 0.5), (-1.5, 1.0, -1.0, 1.5)]
PALATE = np.array([[0.0, 6.0, 2.0], [0.0, 15.0, 10.0], [0.0, 26.0, 13.0], [0.0, 40.0, 9.0]])
BARE = "."  # a title of next to nothing


@pytest.fixture(scope="module")
def model():
    return bundled_model()


@pytest.fixture(scope="module")
def scene(model):
    _, session = bundled_recording()
    roles, vertices = tuple(session.correspondences), tuple(session.correspondences.values())
    bare = dataclasses.replace(session, palate=None)  # a line that would hide some of the tongue
    return scene_of(model, bare, roles, vertices, BARE)


@pytest.fixture(scope="module")
def drawing(scene):
    """An offscreen renderer of the bundled model, dark."""
    require_egl()
    with Offscreen(scene, SIZE, DARK) as drawn:
        yield drawn


def posed(model, normalised, coils=None, speaker=None, **more):
    """A moment of the bundled model without coils, or with these (3, 3)."""
    normalised = np.asarray(normalised, dtype=float)
    speaker = model.speaker.mean if speaker is None else np.asarray(speaker)
    places = np.zeros((0, 3)) if coils is None else np.asarray(coils, dtype=float)
    states = np.where(np.isnan(places).any(axis=1), CoilState.MISSING, CoilState.TRUSTED)
    return Moment(
        model.pose.raw(normalised), normalised, speaker.copy(), places, np.zeros(len(places)), states, **more
    )


def on_the_tongue(model, scene, normalised, off=(0.0, 0.0, 0.0)):
    vertices = model.vertices(model.speaker.mean, model.pose.raw(normalised))
    return vertices[list(scene.correspondences)] + off


def seen_from(view, area, points):
    """(n, 2) pixels, derived anew from what `View` says: a pinhole at `distance_mm` from the centre."""
    yaw, pitch = np.radians([view.yaw_deg, view.pitch_deg])
    towards_eye = np.array([np.sin(yaw) * np.cos(pitch), -np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), np.sin(yaw), 0])
    up = np.cross(towards_eye, right)
    relative = points - (np.array(view.centre) + view.distance_mm * towards_eye)
    focal = min(area.width, area.height) / 2 / np.tan(np.radians(FIELD_DEG / 2))
    depth = -(relative @ towards_eye)
    x = area.x + area.width / 2 + focal * (relative @ right) / depth
    y = area.y + area.height / 2 - focal * (relative @ up) / depth
    return np.column_stack([x, y])


def silhouette(view, area, vertices, faces, size=SIZE):
    """(height, width) True where any face lies, filled by Pillow."""
    from PIL import Image, ImageDraw

    image = Image.new("1", size)
    pen = ImageDraw.Draw(image)
    corners = seen_from(view, area, vertices) - 0.5
    for face in faces:
        pen.polygon([tuple(corner) for corner in corners[face].tolist()], fill=1)
    return np.array(image)


def unlike(picture, colour, least=12):
    """(height, width) True where the picture is not of this colour."""
    return np.abs(picture.astype(int) - np.round(255 * np.array(colour))).max(axis=-1) > least


def changed(one, other, least=12):
    return np.abs(one.astype(int) - other.astype(int)).max(axis=-1) > least


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


def below_text(area, layout):
    """Rows and columns of an area under two lines of text."""
    top = area.y + layout.margin + 3 * layout.font_px
    return slice(top, area.y + area.height), slice(area.x, area.x + area.width)


def nearest(picture, place, colour, reach=1):
    """By how much the pixel nearest in colour around a place differs from the colour, 0 to 255."""
    x, y = np.floor(place).astype(int)
    around = picture[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(int)
    return np.abs(around - np.round(255 * np.array(colour))).max(axis=-1).min()


def flat_place(drawing, points):
    """(n, 2) pixels in the flat view, from two marks of its own: the scale bar is 10 mm, the extent's middle is in
    the area's middle."""
    area, (low, high) = drawing.renderer.layout.flat, drawing.renderer.scene.extent
    room = np.array([area.width, area.height]) - 2 * 2.2 * drawing.renderer.layout.font_px
    scale = min(room / (high - low)[1:])
    off = (points[:, 1:] - (low + high)[1:] / 2) * scale
    return np.column_stack([area.x + area.width / 2 + off[:, 0], area.y + area.height / 2 - off[:, 1]])


# The tongue -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalised", POSES)
@pytest.mark.parametrize("yaw", [52, -30, 90])
def test_the_tongue_covers_the_pixels_that_its_projected_faces_cover(drawing, model, scene, normalised, yaw):
    view = dataclasses.replace(home_view(scene), yaw_deg=yaw)
    moment = posed(model, normalised)
    picture = drawing.picture(moment, view)
    layout = drawing.renderer.layout
    within = below_text(layout.solid, layout)
    vertices = model.vertices(model.speaker.mean, moment.weights)
    expected = silhouette(view, layout.solid, vertices, model.faces)
    drawn = unlike(picture, DARK.background)
    assert expected[within].sum() > 20_000
    assert overlap(drawn[within], expected[within]) > 0.985


def test_another_pose_is_another_picture_and_the_same_pose_the_same(drawing, model, scene):
    view = home_view(scene)
    first = drawing.picture(posed(model, POSES[1]), view)
    second = drawing.picture(posed(model, POSES[2]), view)
    again = drawing.picture(posed(model, POSES[1]), view)
    assert changed(first, second).mean() > 0.02
    assert np.array_equal(first, again)


@pytest.mark.parametrize("normalised", POSES)
def test_positions_and_normals_on_the_card_are_those_of_the_model(model, normalised):
    require_egl()
    context = egl_context()
    speaker = np.array(model.speaker.mean) * 1.3
    surface = Surface(SurfacePrograms(context, model), np.array([5, 955, 17]))
    moment = posed(model, normalised, speaker=speaker)
    surface.show(moment)
    vertices = model.vertices(speaker, moment.weights)
    parts = [
        np.frombuffer(buffer.read(), dtype="f4").reshape(-1, 4)[: model.vertex_count, :3]
        for buffer in (surface.positions, surface.normals)
    ]
    assert np.abs(parts[0] - vertices).max() < 1e-4
    assert np.abs(parts[1] - vertex_normals(vertices, model.faces)).max() < 1e-3
    assert np.allclose(surface.followed(), vertices[[5, 955, 17]], atol=1e-9)
    context.release()


def test_a_free_speaker_looks_as_the_same_speaker_fixed(drawing, model, scene):
    """Drawn after other speakers, frame by frame, or first of all: the weights alone decide."""
    view = home_view(scene)
    wanted = posed(model, POSES[1], speaker=model.speaker.mean * 1.4)
    for factor in (0.7, 1.0, 1.2):
        other = drawing.picture(posed(model, POSES[1], speaker=model.speaker.mean * factor), view)
    free = drawing.picture(wanted, view)
    with Offscreen(scene, SIZE, DARK) as fresh:
        fixed = fresh.picture(wanted, view)
    assert np.array_equal(free, fixed)
    assert changed(free, other).mean() > 0.005


def test_a_model_with_other_numbers_of_weights_is_drawn_as_well(model):
    require_egl()
    fewer = model.truncated(2, 3)
    scene = scene_of(fewer, Session(), (), (), BARE)
    view = home_view(scene)
    moment = posed(fewer, (1.0, -1.0, 2.0))
    with Offscreen(scene, SIZE, DARK) as drawing:
        picture = drawing.picture(moment, view)
        layout = drawing.renderer.layout
    within = below_text(layout.solid, layout)
    vertices = fewer.vertices(fewer.speaker.mean, moment.weights)
    expected = silhouette(view, layout.solid, vertices, fewer.faces)
    assert overlap(unlike(picture, DARK.background)[within], expected[within]) > 0.985


def test_light_falls_from_the_upper_left_and_shadow_stays_red(drawing, model, scene):
    """Tissue: nowhere grey in the shadow, a white gloss somewhere, and many shades between."""
    view = home_view(scene)
    picture = drawing.picture(posed(model, POSES[0]), view).astype(int)
    layout = drawing.renderer.layout
    within = below_text(layout.solid, layout)
    tissue = picture[within][unlike(picture, DARK.background)[within]]
    dark = tissue[tissue.sum(axis=1) <= np.quantile(tissue.sum(axis=1), 0.1)]
    assert (dark[:, 0] > 1.4 * dark[:, 2]).mean() > 0.95
    assert np.ptp(tissue.sum(axis=1)) > 250
    rows, _ = np.nonzero(unlike(picture, DARK.background)[within])
    bright = tissue.sum(axis=1)
    assert bright[rows < np.quantile(rows, 0.3)].mean() > 1.15 * bright[rows > np.quantile(rows, 0.7)].mean()


# The cut --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalised", POSES)
def test_the_contour_of_the_flat_view_runs_through_its_vertices(drawing, model, scene, normalised):
    moment = posed(model, normalised)
    picture = drawing.picture(moment, home_view(scene))
    vertices = model.vertices(model.speaker.mean, moment.weights)
    places = flat_place(drawing, vertices[scene.contour])
    off = [nearest(picture, place, DARK.contour) for place in places]
    assert max(off) < 30


def test_the_cut_is_filled_below_the_contour_and_not_above(drawing, model, scene):
    moment = posed(model, POSES[0])
    picture = drawing.picture(moment, home_view(scene))
    vertices = model.vertices(model.speaker.mean, moment.weights)
    middle = vertices[scene.contour[len(scene.contour) // 2]]
    below, above = flat_place(drawing, np.array([middle - [0, 0, 6], middle + [0, 0, 6]])).astype(int)
    inside = picture[below[1], below[0]].astype(int)
    assert inside[0] > 1.5 * inside[2]
    assert not unlike(picture, DARK.background)[above[1], above[0]]


def test_the_flat_view_has_a_bar_of_ten_millimetres(drawing, model, scene):
    picture = drawing.picture(posed(model, POSES[0]), home_view(scene))
    area = drawing.renderer.layout.flat
    ends = flat_place(drawing, np.array([[0, 0, 0], [0, 10.0, 0]]))[:, 0]
    row = picture[area.y + area.height - 5, area.x : area.x + area.width]
    drawn = np.flatnonzero(~unlike(row[None], DARK.text, 90)[0])
    assert np.ptp(drawn) + 1 == pytest.approx(ends[1] - ends[0], abs=3)


# Coils, palate, ghost, trails -----------------------------------------------------------------------


@pytest.mark.parametrize("look", [DARK, LIGHT])
def test_coils_are_balls_at_their_places_in_both_views(model, scene, look):
    require_egl()
    coils = on_the_tongue(model, scene, POSES[0], off=(0, -1, 3.0))
    view = home_view(scene)
    with Offscreen(scene, SIZE, look) as drawing:
        with_coils = drawing.picture(posed(model, POSES[0], coils), view)
        without = drawing.picture(posed(model, POSES[0]), view)
        layout = drawing.renderer.layout
        places = [seen_from(view, layout.solid, coils), flat_place(drawing, coils)]
    difference = changed(with_coils, without)
    for per_view in places:
        for coil, (x, y) in enumerate(np.round(per_view).astype(int)):
            assert difference[y - 3 : y + 4, x - 3 : x + 4].all()
            seen = with_coils[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(axis=0)
            hue = np.array(look.coils[coil])
            assert np.corrcoef(seen, hue)[0, 1] > 0.8


def test_a_missing_coil_is_not_drawn_but_named(drawing, model, scene):
    view = dataclasses.replace(home_view(scene), trail_s=0)
    coils = on_the_tongue(model, scene, POSES[0], off=(0, 0, 3.0))
    all_there = drawing.picture(posed(model, POSES[0], coils), view)
    x, y = flat_place(drawing, coils)[1].astype(int)
    coils[1] = np.nan
    one_less = drawing.picture(posed(model, POSES[0], coils), view)
    assert unlike(all_there, DARK.background)[y, x]
    assert not unlike(one_less, DARK.background)[y, x]
    layout = drawing.renderer.layout
    third_line = slice(layout.margin + 2 * layout.font_px, layout.margin + 4 * layout.font_px)
    warned = ~unlike(one_less[third_line, : layout.solid.width], DARK.warning, 40)
    assert warned.sum() > 20


def test_a_coil_that_does_not_count_has_the_colour_of_a_warning(drawing, model, scene):
    moment = posed(model, POSES[0], on_the_tongue(model, scene, POSES[0], off=(0, 0, 3.0)))
    moment.coil_states[2] = CoilState.MISFIT
    picture = drawing.picture(moment, home_view(scene))
    x, y = flat_place(drawing, moment.coils)[2].astype(int)
    seen = picture[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(axis=0)
    assert np.corrcoef(seen, DARK.warning)[0, 1] > 0.95


def test_a_stick_leads_from_each_coil_to_its_vertex(drawing, model, scene):
    feet = on_the_tongue(model, scene, POSES[0])
    coils = feet + [0, 0, 9.0]
    view = dataclasses.replace(home_view(scene), trail_s=0)
    picture = drawing.picture(posed(model, POSES[0], coils), view)
    for place in flat_place(drawing, 0.35 * coils + 0.65 * feet):
        assert nearest(picture, place, DARK.text) < 60


@pytest.mark.parametrize("look", [DARK, LIGHT])
def test_the_palate_is_a_line_in_both_views(model, scene, look):
    require_egl()
    with_palate = dataclasses.replace(scene, palate=PALATE)
    view = home_view(with_palate)
    with Offscreen(with_palate, SIZE, look) as drawing:
        picture = drawing.picture(posed(model, POSES[0]), view)
        solid = drawing.renderer.layout.solid
        assert max(nearest(picture, p, look.palate) for p in flat_place(drawing, PALATE)) < 30
        seen = [nearest(picture, p, look.palate) for p in seen_from(view, solid, PALATE)]
    assert max(seen) < 30


def test_a_ghost_shows_where_it_differs_from_the_tongue(drawing, model, scene):
    view = home_view(scene)
    moment, ghost = posed(model, (0, 0, 0, 0)), posed(model, (2.5, 2.5, 0, 0))
    plain = drawing.picture(moment, view)
    haunted = drawing.picture(moment, dataclasses.replace(view, ghost=ghost))
    layout = drawing.renderer.layout
    shapes = [
        silhouette(view, layout.solid, model.vertices(model.speaker.mean, m.weights), model.faces)
        for m in (moment, ghost)
    ]
    only_ghost = shapes[1] & ~shapes[0]
    assert only_ghost.sum() > 500
    assert changed(plain, haunted, 4)[only_ghost].mean() > 0.9
    contour = model.vertices(model.speaker.mean, ghost.weights)[scene.contour]
    places = flat_place(drawing, contour)
    assert np.median([nearest(haunted, place, DARK.ghost) for place in places]) < 40
    assert np.median([nearest(plain, place, DARK.ghost) for place in places]) > 60


def test_a_coil_leaves_a_trail_that_ends_with_its_time_and_with_a_jump_backwards(drawing, model, scene):
    view = dataclasses.replace(home_view(scene), trail_s=0.5)
    start = on_the_tongue(model, scene, POSES[0], off=(0, 0, 4.0))
    for step in range(21):
        moment = posed(model, POSES[0], start + [0, 0.4 * step, 0.3 * step], time_s=100 + 0.02 * step)
        trailing = drawing.picture(moment, view)
    plain = drawing.picture(moment, dataclasses.replace(view, trail_s=0))
    half_way = flat_place(drawing, start + [0, 0.4 * 14, 0.3 * 14])
    assert all(changed(trailing, plain)[y - 1 : y + 2, x - 1 : x + 2].any() for x, y in half_way.astype(int))
    drawing.picture(dataclasses.replace(moment, time_s=50.0), view)
    scrubbed = drawing.picture(dataclasses.replace(moment, time_s=50.02), view)
    assert not any(
        changed(scrubbed, plain)[y - 1 : y + 2, x - 1 : x + 2].any() for x, y in half_way.astype(int)
    )


def test_remembered_moments_leave_the_same_trail_as_drawn_ones(model, scene):
    require_egl()
    view = dataclasses.replace(home_view(scene), trail_s=0.5)
    start = on_the_tongue(model, scene, POSES[0], off=(0, 0, 4.0))
    moments = [posed(model, POSES[0], start + [0, 0.5 * i, 0], time_s=0.02 * i) for i in range(12)]
    with Offscreen(scene, SIZE, DARK) as drawing:
        for moment in moments:
            drawn = drawing.picture(moment, view)
    with Offscreen(scene, SIZE, DARK) as drawing:
        for moment in moments[:-1]:
            drawing.renderer.remember(moment)
        assert np.array_equal(drawing.picture(moments[-1], view), drawn)


def test_what_is_remembered_for_trails_stays_small_however_long_a_run_is(drawing, model, scene):
    moment = posed(model, POSES[0], on_the_tongue(model, scene, POSES[0]))
    for frame in range(10_000):
        drawing.renderer.remember(dataclasses.replace(moment, time_s=0.004 * frame))
    assert len(drawing.renderer._past) <= 1001


def test_colours_tell_the_distance_to_the_palate(model, scene):
    require_egl()
    near = dataclasses.replace(scene, palate=model.mean_vertices()[scene.contour[5:30]] + [0, 0, 1.0])
    far = dataclasses.replace(scene, palate=near.palate + [0, 0, 20.0])
    shares = []
    for one in (near, far):
        view = dataclasses.replace(home_view(near), colour_by="palate", pitch_deg=60, yaw_deg=0)
        with Offscreen(one, SIZE, DARK) as drawing:
            picture = drawing.picture(posed(model, POSES[0]), view).astype(int)
            solid = drawing.renderer.layout.solid
        place = seen_from(view, solid, model.mean_vertices()[scene.contour[17:18]] + [5.0, 0, 0])[0].astype(
            int
        )
        red, _, blue = picture[place[1], place[0]]
        shares.append(red / blue)
    assert shares[0] > 1.3 and shares[1] < 0.8


def test_colours_tell_how_uncertain_a_vertex_is(drawing, model, scene):
    view = dataclasses.replace(home_view(scene), colour_by="uncertainty")
    seen = posed(model, POSES[0], on_the_tongue(model, scene, POSES[0]))
    unseen = dataclasses.replace(seen, coils=np.full((3, 3), np.nan))
    layout = drawing.renderer.layout
    within = below_text(layout.solid, layout)
    expected = silhouette(view, layout.solid, model.mean_vertices(), model.faces)[within]
    colours = [drawing.picture(m, view)[within][expected].mean(axis=0) for m in (seen, unseen)]
    ratio = [red / blue for red, _, blue in colours]
    assert ratio[1] > 1.8 * ratio[0]


# Words and bars -------------------------------------------------------------------------------------


def letters(drawing, moment, view):
    """Rows of all letters of a picture."""
    rows = []
    draw = drawing.renderer._drawer.draw
    drawing.renderer._drawer.draw = lambda marks, *rest: (
        rows.append(marks.kinds[LETTER]),
        draw(marks, *rest),
    )
    try:
        drawing.picture(moment, view)
    finally:
        drawing.renderer._drawer.draw = draw
    return np.concatenate(rows)


@pytest.mark.parametrize("size", [*SIZES, (400, 900)])
def test_no_letter_is_cut_by_the_pictures_edge_or_runs_into_another_area(model, scene, size):
    require_egl()
    long = dataclasses.replace(
        scene,
        title="a_very_long_file_name_without_any_blank_" * 3 + "of a synthetic recording.csv",
        palate=PALATE,
    )
    view = dataclasses.replace(
        home_view(long),
        colour_by="palate",
        lines=("250 Hz in, 60 Hz out, host p99 0.41 ms " * 4, "a take " * 30),
    )
    coils = on_the_tongue(model, scene, POSES[0]) + [[0, -8, 0], [0, 0, 0], [0, 14, 0]]
    moment = posed(
        model, (4.5, -5.0, 12.0, -0.0), coils, status=PoseStatus.HELD, residual_mm=123.4, time_s=98765.4
    )
    moment.coil_states[:] = CoilState.RETURNING
    with Offscreen(long, size, DARK) as drawing:
        rows = letters(drawing, moment, view)
        layout = drawing.renderer.layout
        font = layout.font_px
    left, top, right = rows[:, 0], rows[:, 1], rows[:, 2] - 2
    assert len(rows) > 200
    assert left.min() >= 0 and right.max() <= size[0]
    assert top.min() >= 0 and (top + 1.25 * font).max() <= size[1]
    edge = layout.flat.x
    assert not ((left < edge - 1) & (right > edge + 1)).any()


@pytest.mark.parametrize("look", [DARK, LIGHT])
def test_words_on_the_tongue_have_the_ground_behind_them(model, scene, look):
    require_egl()
    view, moment = home_view(scene), posed(model, POSES[0])
    many = dataclasses.replace(view, lines=("a line as wide as it is here, more or less",) * 30)
    with Offscreen(scene, SIZE, look) as drawing:
        plain, covered = (drawing.picture(moment, one) for one in (view, many))
        rows = letters(drawing, moment, many)
    middle = (np.abs(rows[:, 0] - 0.27 * SIZE[0]) < 60) & (np.abs(rows[:, 1] - 0.5 * SIZE[1]) < 60)
    left, top = rows[middle, :2].min(axis=0).astype(int)
    right, bottom = rows[middle, :2].max(axis=0).astype(int)
    ground = np.round(255 * np.array(look.background))
    far, near = (
        np.median(np.abs(picture[top:bottom, left:right] - ground).max(axis=-1))
        for picture in (plain, covered)
    )
    assert (
        far > 100 and near < 0.5 * far
    )  # the tongue is there, and what is between the letters is nearly the ground


def test_more_lines_than_there_is_room_for_are_counted(drawing, model, scene):
    view = dataclasses.replace(home_view(scene), lines=tuple(f"line {number}" for number in range(100)))
    rows = letters(drawing, posed(model, POSES[0]), view)
    assert rows[:, 1].max() + drawing.renderer.layout.font_px <= SIZE[1]
    few = letters(drawing, posed(model, POSES[0]), dataclasses.replace(view, lines=("line 1",)))
    assert len(few) < len(rows) < len(few) + 100 * 6


def test_names_of_coils_at_one_place_stand_below_each_other(drawing, model, scene):
    together = np.repeat(on_the_tongue(model, scene, POSES[0])[:1], 3, axis=0)
    view = home_view(scene)
    plain = letters(drawing, posed(model, POSES[0]), view)
    named = letters(drawing, posed(model, POSES[0], together), view)
    flat = drawing.renderer.layout.flat
    in_flat = [
        rows[(rows[:, 0] >= flat.x) & (rows[:, 1] < flat.y + 0.7 * flat.height)] for rows in (plain, named)
    ]
    heights = np.unique(in_flat[1][:, 1])
    assert len(in_flat[0]) == 0 and len(heights) == 3
    assert np.diff(heights).min() >= drawing.renderer.layout.font_px


@pytest.mark.parametrize("look", [DARK, LIGHT])
def test_bars_are_as_high_as_the_weights_in_sigma(model, scene, look):
    """Between the lines of -3 and +3 lie six sigma."""
    require_egl()
    with Offscreen(scene, SIZE, look) as drawing:
        picture = drawing.picture(posed(model, (2.0, -1.0, 3.5, 0.0)), home_view(scene))
        area = drawing.renderer.layout.bars
    right_edge = picture[area.y : area.y + area.height, area.x + area.width - 9]
    lines = np.flatnonzero(unlike(right_edge[None], look.background, 20)[0])
    lines = lines[np.concatenate([[True], np.diff(lines) > 2])]
    per_sigma = (lines[2] - lines[0]) / 6
    panel = picture[area.y : area.y + area.height, area.x : area.x + area.width]
    bar = ~unlike(panel, look.bar, 8)
    columns = np.flatnonzero(bar.sum(axis=0) > 3)
    groups = np.split(columns, np.flatnonzero(np.diff(columns) > 8) + 1)
    heights = [bar[:, group[len(group) // 2]].sum() for group in groups]
    assert heights == pytest.approx([2 * per_sigma, per_sigma], abs=2.5)
    beyond = ~unlike(panel, look.warning, 8)
    assert beyond.sum(axis=0).max() == pytest.approx(3.5 * per_sigma, abs=2.5)


@pytest.mark.parametrize("look", [DARK, LIGHT])
def test_words_stand_out_from_the_ground(look):
    """A contrast of at least 4.5 to 1, as the web's guidelines for accessible content ask of small text."""

    def luminance(colour):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
        return np.dot(linear, [0.2126, 0.7152, 0.0722])

    for ground in (look.background, look.panel):
        for words in (look.text, look.faint_text, look.warning):
            bright, dark = sorted([luminance(words), luminance(ground)], reverse=True)
            assert (bright + 0.05) / (dark + 0.05) > 4.5


def test_a_letter_that_the_font_does_not_have_does_no_harm(drawing, model, scene):
    view = dataclasses.replace(home_view(scene), lines=("Jürgen Müller, \u8a9e\u97f3 \U0001f600",))
    plain = dataclasses.replace(view, lines=("Jurgen Muller, ?? ?",))
    assert np.array_equal(
        drawing.picture(posed(model, POSES[0]), view), drawing.picture(posed(model, POSES[0]), plain)
    )


# Sizes, smooth edges, and what is not there ---------------------------------------------------------


def test_a_resized_renderer_draws_as_one_made_in_that_size(model, scene):
    require_egl()
    view, moment = home_view(scene), posed(model, POSES[1])
    with Offscreen(scene, (640, 360), DARK) as small, Offscreen(scene, SIZE, DARK) as large:
        large.picture(moment, view)
        with large._context:
            large.renderer.resize((640, 360))
        picture = large.picture(moment, view)[-360:, :640]
        assert np.array_equal(picture, small.picture(moment, view))


def test_samples_make_edges_smooth_and_change_nothing_else(model, scene, drawing):
    view, moment = home_view(scene), posed(model, POSES[1])
    plain = drawing.picture(moment, view)
    with Offscreen(scene, SIZE, DARK, samples=4) as smooth:
        picture = smooth.picture(moment, view)
    assert 0.0005 < changed(plain, picture, 20).mean() < 0.02


def test_without_the_library_the_sentence_names_the_packages(monkeypatch):
    moderngl = pytest.importorskip("moderngl")

    def fails(**_):
        raise ImportError("libEGL.so not found\nmore")

    monkeypatch.setattr(moderngl, "create_context", fails)
    with pytest.raises(
        InputError, match=r"libEGL.so not found\).*apt install libegl1 libgl1 libgl1-mesa-dri$"
    ):
        offscreen.egl_context()


@pytest.mark.parametrize("package", ["moderngl"])
def test_without_the_extra_the_sentence_names_it(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"pip install 'tonguetrack\[viewer\]'"):
        offscreen.egl_context()
