"""Results are kept by what they were made from: nothing is made twice, and nothing stale or damaged is taken."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import working
from hypothesis import given
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.model.mri.caching import Cache, Source, Step, Stored, key_of, run_step, source
from tonguetrack.parallel import Failed, local

MADE: list[float] = []


def doubled(number, other=None):
    MADE.append(number)
    if number < 0:
        raise InputError(f"{number} is negative.")
    return {"twice": np.array([2.0 * number]), "other": np.zeros(0) if other is None else other["twice"]}


DOUBLED = Step("doubled", 1, doubled)


@dataclass(frozen=True)
class Weights:
    first: float = 1.0
    second: tuple[float, ...] = (1.0, 2.0)
    named: dict[str, np.ndarray] = field(default_factory=dict)


@pytest.fixture
def cache(tmp_path) -> Cache:
    MADE.clear()
    return Cache(tmp_path)


def run(cache, rows, step=DOUBLED, progress=None):
    with local(1) as executor:
        return run_step(cache, step, rows, executor, progress)


# What is made, and what is not ----------------------------------------------------------------------


def test_a_result_is_made_once(cache):
    first = run(cache, [(1,), (2,)])
    again = run(cache, [(1,), (2,), (3,)])
    assert MADE == [1, 2, 3]
    assert again[:2] == first
    np.testing.assert_array_equal(cache.load(again[2].key)["twice"], [6.0])


def test_rows_that_are_the_same_are_made_once(cache):
    assert len({kept.key for kept in run(cache, [(1,), (1,), (1,)])}) == 1
    assert MADE == [1]


def test_a_new_version_of_a_step_makes_everything_again(cache):
    run(cache, [(1,)])
    run(cache, [(1,)], Step("doubled", 2, doubled))
    assert MADE == [1, 1]


def test_what_depends_on_a_changed_result_is_made_again_and_nothing_else(cache):
    def chain(first, second):
        one, two = run(cache, [(first,), (second,)])
        return run(cache, [(10, one), (20, two)])

    chain(1, 2)
    MADE.clear()
    chain(1, 3)
    assert MADE == [3, 20]


def test_results_of_earlier_steps_arrive_as_their_arrays_alone_and_in_tuples(cache):
    def joined(parts):
        return {"sum": sum(part["twice"] for part in parts)}

    (one, two) = run(cache, [(1,), (2,)])
    (result,) = run(cache, [((one, two),)], Step("joined", 1, joined))
    np.testing.assert_array_equal(cache.load(result.key)["sum"], [6.0])


def test_what_fails_is_told_and_tried_again_while_the_rest_is_kept(cache):
    outcomes = run(cache, [(1,), (-2,), (3,)])
    assert outcomes[1] == Failed("-2 is negative.")
    assert isinstance(outcomes[0], Stored) and isinstance(outcomes[2], Stored)
    run(cache, [(1,), (-2,), (3,)])
    assert MADE == [1, -2, 3, -2]


def test_progress_counts_what_is_kept_as_done(cache):
    run(cache, [(1,), (2,)])
    told = []
    run(cache, [(1,), (2,), (3,)], progress=lambda done, total: told.append((done, total)))
    assert told == [(2, 3), (3, 3)]


def test_processes_share_one_folder(cache):
    with local(2) as executor:
        kept = run_step(cache, Step("twice", 1, working.twice), [(number,) for number in range(5)], executor)
    assert [float(cache.load(one.key)["twice"][0]) for one in kept] == [0.0, 2.0, 4.0, 6.0, 8.0]


# Keys -----------------------------------------------------------------------------------------------

VALUES = [
    None, True, 1, 1.0, "1", b"1", 0.1, "0.1", (1, 2), ((1,), 2), (1, (2,)), {"a": 1}, {"a": 2}, {"b": 1},
    np.array([1.0, 2.0]), np.array([1, 2]), np.array([[1.0, 2.0]]), np.array([[1.0], [2.0]]), Weights(),
    Weights(2.0), Weights(second=(1.0, 3.0)), Weights(named={"Tip": np.zeros(3)}), Stored("ab"), "ab",
    Source(Path("x"), "ab"),
]  # fmt: skip


def test_different_arguments_have_different_keys():
    keys = [key_of(DOUBLED, (value,)) for value in VALUES]
    assert len(set(keys)) == len(VALUES)
    assert len({key_of(DOUBLED, row) for row in (("ab", "c"), ("a", "bc"), ("abc",), (("ab", "c"),))}) == 4


def test_the_order_of_a_mapping_and_the_layout_of_an_array_do_not_count():
    one = {"a": np.arange(6.0).reshape(2, 3), "b": 1}
    other = {"b": 1, "a": np.asfortranarray(np.arange(6.0).reshape(2, 3))}
    assert key_of(DOUBLED, (one,)) == key_of(DOUBLED, (other,))


def test_something_without_a_lasting_value_is_refused_as_an_argument():
    with pytest.raises(TypeError, match="object"):
        key_of(DOUBLED, (object(),))


def test_of_a_file_only_the_content_counts(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    one.write_bytes(b"content")
    other.write_bytes(b"content")
    assert key_of(DOUBLED, (source(one),)) == key_of(DOUBLED, (source(other),))
    other.write_bytes(b"Content")
    assert key_of(DOUBLED, (source(one),)) != key_of(DOUBLED, (source(other),))


def test_of_a_folder_names_and_contents_count(tmp_path):
    digests = set()
    for names, contents in ((("a", "b"), (b"1", b"2")), (("a", "b"), (b"2", b"1")), (("a", "c"), (b"1", b"2")),
                            (("a",), (b"12",)), (("a", "b"), (b"12", b""))):  # fmt: skip
        folder = tmp_path / str(len(digests))
        folder.mkdir()
        for name, content in zip(names, contents, strict=True):
            (folder / name).write_bytes(content)
        digests.add(source(folder).digest)
    assert len(digests) == 5


def test_a_file_that_is_gone_is_named(tmp_path):
    with pytest.raises(InputError, match="gone"):
        source(tmp_path / "gone")


# The files ------------------------------------------------------------------------------------------


@given(st.data())
def test_a_damaged_result_is_noticed_wherever_the_damage_is(tmp_path_factory, data):
    cache = Cache(tmp_path_factory.mktemp("work"))
    cache.store("0" * 64, {"one": np.arange(5.0), "other": np.zeros(0)})
    whole = cache.path("0" * 64).read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    spoiled = bytearray(whole)
    spoiled[place] ^= data.draw(st.integers(1, 255))
    damaged = data.draw(st.sampled_from([bytes(spoiled), whole[:place]]))
    cache.path("0" * 64).write_bytes(damaged)
    assert not cache.holds("0" * 64)
    with pytest.raises(InputError, match="absent or damaged"):
        cache.load("0" * 64)


def test_a_damaged_result_is_made_again(cache):
    (kept,) = run(cache, [(1,)])
    cache.path(kept.key).write_bytes(b"something else")
    run(cache, [(1,)])
    assert MADE == [1, 1]
    np.testing.assert_array_equal(cache.load(kept.key)["twice"], [2.0])


def test_results_are_plain_archives_that_numpy_opens_without_pickle(cache):
    (kept,) = run(cache, [(4,)])
    with np.load(cache.path(kept.key), allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["twice"], [8.0])
