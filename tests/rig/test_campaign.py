"""Some trials of every kind of fault; the benchmark of that name runs two thousand."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.rig.campaign import INTERRUPT, READERS, STAGES, Outcome, kinds, trial

PER_KIND = 4
UNDISTURBED = 6


@pytest.fixture(scope="module")
def pool() -> Iterator[ProcessPoolExecutor]:
    # Each trial takes signals, and so needs the main thread of a process.
    with ProcessPoolExecutor(4, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="module")
def outcomes(pool: ProcessPoolExecutor) -> list[Outcome]:
    jobs = [(seed, kind) for number, kind in enumerate(kinds()) for seed in range(number, PER_KIND * len(kinds()), len(kinds()))]
    return list(pool.map(trial, *zip(*jobs, strict=True)))


@pytest.mark.slow
def test_nothing_hangs_no_wrong_reading_is_good_and_no_arm_leaves_its_limits(outcomes: list[Outcome]) -> None:
    assert {outcome: outcome.wrong for outcome in outcomes if outcome.wrong} == {}


@pytest.mark.slow
def test_every_kind_struck_and_every_make_was_there(outcomes: list[Outcome]) -> None:
    assert {outcome.kind for outcome in outcomes if outcome.struck} == set(kinds())
    assert {part for outcome in outcomes for part in outcome.bench.split("/")[:2]} >= {*STAGES, "linear"}


@pytest.mark.slow
def test_every_work_was_done_and_some_of_it_interrupted(outcomes: list[Outcome]) -> None:
    assert (
        {"sweep", "interrupted sweep", "om20", "optoncdt"}
        <= {outcome.work for outcome in outcomes}
        <= {"sweep", "interrupted sweep", *READERS}
    )
    interrupted = [outcome for outcome in outcomes if outcome.ended == "Interrupted"]
    assert {outcome.kind == INTERRUPT for outcome in interrupted} == {True, False}


@pytest.mark.slow
def test_harm_on_the_wire_is_mostly_made_good_and_reported(outcomes: list[Outcome]) -> None:
    on_the_wire = [outcome for outcome in outcomes if outcome.struck and outcome.kind in ("cut-short", "dropped-byte", "doubled-byte")]
    complete = [outcome for outcome in on_the_wire if outcome.ended == "complete"]
    assert len(complete) > len(on_the_wire) / 2
    assert any("repeated" in outcome.dealt_with for outcome in complete)


@pytest.mark.slow
def test_nothing_is_wrong_where_nothing_is_done(pool: ProcessPoolExecutor) -> None:
    for outcome in pool.map(trial, range(900, 900 + UNDISTURBED)):
        assert (outcome.ended, outcome.wrong, outcome.dealt_with, outcome.flagged, outcome.stored) == ("complete", (), (), 0, 4)
