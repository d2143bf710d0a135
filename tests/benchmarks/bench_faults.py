"""Two thousand sweeps on benches of mixed make, and readings along a linear axis, one seeded fault each, some interrupted: does anything
hang, is a wrong reading taken for good, does an arm leave its limits, does anything begin after the interrupt?
"""

import multiprocessing
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import count, islice

from tests.benchmarks.report import verdict
from tests.rig.campaign import Outcome, kinds, trial

STRIKES = 2000
WORKERS = 8
"""A trial waits for most of its time."""


def main() -> int:
    """Run trials until that many faults have struck, and print what became of them by kind."""
    outcomes = [outcome for outcome in campaign(STRIKES) if outcome.struck]
    print(table(outcomes))
    bad = [outcome for outcome in outcomes if outcome.wrong]
    for outcome in bad:
        print(f"   seed {outcome.seed}, {outcome.kind} at {outcome.where} of {outcome.bench}: {'; '.join(outcome.wrong)}")
        print(f"      the fault: {outcome.struck}; ended {outcome.ended} {outcome.message}")
    wrong = Counter(_what(text) for outcome in bad for text in outcome.wrong)
    return (
        verdict("trials that hung", wrong["hang"], 0)
        + verdict("wrong readings stored as good", wrong["stored"], 0)
        + verdict("arms outside their limits", wrong["limits"], 0)
        + verdict("motions begun after an interrupt", wrong["interrupt"], 0)
        + verdict("ended with no error of ours, or an arm still moving", wrong["other"], 0)
    )


def campaign(strikes: int, workers: int = WORKERS) -> Iterator[Outcome]:
    """Yield the outcomes of as many trials as it takes for so many faults to strike; the same ones each time."""
    names = kinds()
    plan = ((seed, names[seed % len(names)]) for seed in count())
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        struck = done = 0
        while struck < strikes:
            batch = [pool.submit(trial, *job) for job in islice(plan, strikes - struck)]
            for future in as_completed(batch):
                outcome = future.result()
                struck += bool(outcome.struck)
                done += 1
                if done % 200 == 0:
                    print(f"   {done} trials, {struck} faults struck", flush=True)
                yield outcome


def table(outcomes: list[Outcome]) -> str:
    """Return a table of kinds of faults, and of what was being done, against what became of it."""
    heads = ("struck", "all good", "flagged", "named error", "wrong", "done about it")
    lines = [f"   {'fault':<18}" + "".join(f"{head:>13}" for head in heads[:-1]) + f"  {heads[-1]}"]
    for row in (*kinds(), "", *sorted({outcome.work for outcome in outcomes}), "all"):
        own = [outcome for outcome in outcomes if row in (outcome.kind, outcome.work, "all")]
        if not row:
            lines.append("")
            continue
        complete = [outcome for outcome in own if outcome.ended == "complete" and not outcome.wrong]
        flagged = sum(outcome.flagged > 0 for outcome in complete)
        wrong = sum(bool(outcome.wrong) for outcome in own)
        errors = Counter(outcome.ended for outcome in own if outcome.ended != "complete" and not outcome.wrong)
        numbers = (len(own), len(complete) - flagged, flagged, sum(errors.values()), wrong)
        acts = Counter(what for outcome in own for what in set(outcome.dealt_with))
        about = ", ".join(f"{name} {number}" for name, number in [*errors.most_common(3), *acts.most_common(3)])
        lines.append(f"   {row:<18}" + "".join(f"{number:>13}" for number in numbers) + f"  {about}")
    return "\n".join(lines)


def _what(text: str) -> str:
    for part, name in (("hang", "hang"), ("stored", "stored"), ("beyond", "limits"), ("after the interrupt", "interrupt")):
        if part in text:
            return name
    return "other"
