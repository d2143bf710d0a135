"""When a device that answers in order is resynchronised, and how often it is asked; what devices on one link share."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.doubt import Doubt
from drivers.errors import DeviceFault, TransportTimeout, UnexpectedReply
from drivers.motion import Stops


class Device:
    """Answers with what it is given, or raises it, and writes down what it was asked."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.asked = list(answers), list[str]()
        self.doubt = Doubt()

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
    assert one.shared(Stops) is not one.shared(Doubt)
