"""When a device that answers in order is resynchronised, and how often it is asked; what devices on one link share."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.doubt import Doubt
from drivers.errors import DeviceFault, TransportTimeout, UnexpectedReply


class Told:
    """Takes a link's place and writes down what it is told."""

    def __init__(self) -> None:
        self.incidents: list[tuple[str, str, str, str]] = []

    def tell(self, what: str, detail: str, *, device: str, attempt: str) -> None:
        """Write down."""
        self.incidents.append((what, detail, device, attempt))


class Device:
    """Answers with what it is given, or raises it, and writes down what it was asked."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.asked = list(answers), list[str]()
        self.link = Told()
        self.doubt = Doubt(self.link)  # type: ignore[arg-type]

    def question(self) -> Any:
        self.asked.append("question")
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def resynchronise(self) -> None:
        self.asked.append("resynchronise")
        self.doubt.settled()

    def once(self) -> Any:
        return self.doubt.once(self.question, self.resynchronise)

    def twice(self) -> Any:
        return self.doubt.twice(self.question, self.resynchronise)


def test_there_is_doubt_before_the_first_question_only() -> None:
    device = Device(1, 2)
    assert (device.once(), device.once()) == (1, 2)
    assert device.asked == ["resynchronise", "question", "question"]
    assert device.link.incidents == []


@pytest.mark.parametrize("error", [TransportTimeout("nothing came"), UnexpectedReply("nonsense")])
def test_what_changes_something_is_never_repeated_and_leaves_doubt(error: Exception) -> None:
    device = Device(error, 2)
    with pytest.raises(type(error)):
        device.once()
    assert device.once() == 2
    assert device.asked == ["resynchronise", "question"] * 2


def test_what_may_be_asked_twice_is_asked_twice_and_not_three_times() -> None:
    device = Device(TransportTimeout("nothing"), 2, UnexpectedReply("nonsense"), TransportTimeout("nothing"))
    assert device.twice() == 2
    with pytest.raises(TransportTimeout):
        device.twice()
    assert device.asked == ["resynchronise", "question", "resynchronise", "question", "question", "resynchronise", "question"]


WHO = {"device": "meter", "attempt": "reading"}


def test_repeats_and_resynchronisations_are_told_with_their_cause() -> None:
    device = Device(1, TransportTimeout("nothing", **WHO), 2, UnexpectedReply("nonsense", raw=b"?", **WHO), 3)  # type: ignore[arg-type]
    assert (device.once(), device.twice(), device.twice()) == (1, 2, 3)
    timeout, nonsense = "TransportTimeout: nothing", "UnexpectedReply: nonsense, got 3f"
    assert device.link.incidents == [
        (what, why, "meter", "reading") for why in (timeout, nonsense) for what in ("repeated", "resynchronised")
    ]


def test_what_was_not_repeated_is_told_once_nothing_is_owed_any_more() -> None:
    device = Device(1, TransportTimeout("nothing", **WHO), 2)  # type: ignore[arg-type]
    device.once()
    with pytest.raises(TransportTimeout):
        device.once()
    assert device.link.incidents == []
    assert device.once() == 2
    assert device.link.incidents == [("resynchronised", "TransportTimeout: nothing", "meter", "reading")]


def test_a_stop_waits_for_nobody_and_is_sent_twice_at_most() -> None:
    device = Device(1, 2, TransportTimeout("nothing", **WHO), 3, TransportTimeout("nothing"), TransportTimeout("again"), 4)  # type: ignore[arg-type]
    device.once()
    assert device.doubt.urgently(device.question) == 2
    assert device.link.incidents == []
    assert device.doubt.urgently(device.question) == 3
    assert device.link.incidents == [("repeated", "TransportTimeout: nothing", "meter", "reading")]
    with pytest.raises(TransportTimeout, match="again"):
        device.doubt.urgently(device.question)
    assert "resynchronise" not in device.asked[1:]
    assert device.once() == 4  # and what was owed to the stops is dropped first
    assert device.asked[-2:] == ["resynchronise", "question"]


def test_a_refusal_is_an_answer() -> None:
    device = Device(DeviceFault("refused"), 2)
    with pytest.raises(DeviceFault):
        device.twice()
    assert device.twice() == 2
    assert device.asked == ["resynchronise", "question", "question"]


def test_devices_of_a_kind_on_one_link_share_one_thing(plug: Any) -> None:
    one, other = plug(), plug()
    assert one.shared(Doubt) is one.shared(Doubt)
    assert one.shared(Doubt) is not other.shared(Doubt)
    assert one.shared(lambda link: link) is one


def test_a_link_is_told(plug: Any) -> None:
    link = plug(report=lambda incident: told.append(str(incident)))
    told: list[str] = []
    doubt = Doubt(link)
    doubt.twice(Device(UnexpectedReply("nonsense", **WHO), 2).question, doubt.settled)  # type: ignore[arg-type]
    assert told == [f"meter on {link.url}: reading: {what} (UnexpectedReply: nonsense)" for what in ("repeated", "resynchronised")]
