"""What each axis was last told, on the disk, so that the next program that opens it knows."""

import fcntl
import json
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drivers.kinds import AxisState, ForgetfulStage, Stage
from rig.errors import RunError
from rig.files import write_atomically
from rig.kinematics import AxisMap

SCHEMA_VERSION = 1

PATIENCE_S = 2.0
"""How long another program may take to write."""

LOOK_S = 0.002


@dataclass(frozen=True)
class AxisRecord:
    """The last command to an axis and what came of it; positions as the stage counts.

    Attributes
    ----------
    setpoint : float, optional
        Where it was sent; None for homing.
    readback : float
        Where it stood, when `under_way` just before the command went out.
    under_way : bool
        The motion was begun and nobody has seen its end.
    homed : bool
        The stage had its reference.
    time : float, s
        When this was written (`time.time`).
    """

    setpoint: float | None
    readback: float
    under_way: bool
    homed: bool
    time: float

    def vouches(self, state: AxisState, tolerance: float) -> bool:
        """Tell whether an axis whose controller forgets must still have its reference: it was left homed, and is as it was left.

        A counter that was switched off reads 0, wherever the arm stands: at 0 nothing tells the two apart.
        """
        as_left = not self.under_way and not state.moving and abs(state.position - self.readback) <= tolerance
        return self.homed and as_left and abs(state.position) > tolerance


class AxisRecords:
    """The records of all axes of a workspace, by the stage's identity; safe from any thread.

    Parameters
    ----------
    path : Path
        A JSON file, replaced as a whole and brought to the disk at each change.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()

    def get(self, identity: str) -> AxisRecord | None:
        """Return what is known of a stage.

        Raises
        ------
        RunError
            The file is there and is not what it should be.
        """
        with self._lock:
            return self._read().get(identity)

    def put(self, identity: str, *, setpoint: float | None, readback: float, under_way: bool, homed: bool) -> None:
        """Write down what a stage was told, or where it came to rest; on the disk when this returns.

        Raises
        ------
        RunError
            It cannot be written. Before a motion: it should not begin then.
        """
        record = AxisRecord(setpoint, readback, under_way, homed, time.time())
        with self._lock:
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with self._alone():
                    records = {**self._read(), identity: record}
                    document = {"schema_version": SCHEMA_VERSION, "axes": {key: asdict(each) for key, each in records.items()}}
                    write_atomically(self._path, json.dumps(document, indent=1, allow_nan=False) + "\n")
            except OSError as exc:
                lost = "no motion begins without it" if under_way else "where the axis stands now is not on record"
                raise RunError(f"{self._path}: cannot be written: {exc.strerror or exc}; {lost}") from exc

    def fields(self) -> dict[str, dict[str, Any]]:
        """Return all records as they are written; none where the file cannot be read."""
        with self._lock:
            try:
                return {key: asdict(record) for key, record in self._read().items()}
            except RunError:
                return {}

    def of(self, identity: str) -> "AxisMemory":
        """Return the part that is about one stage."""
        return AxisMemory(self, identity)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Keep programs that move other axes of this workspace from writing between our reading and our writing."""
        with self._path.with_name(f".{self._path.name}.lock").open("a") as file:
            deadline = time.monotonic() + PATIENCE_S
            while True:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() > deadline:
                        raise OSError(f"another program has been writing it for {PATIENCE_S:g} s") from None
                    time.sleep(LOOK_S)
            yield

    def _read(self) -> Mapping[str, AxisRecord]:
        try:
            document = json.loads(self._path.read_text(encoding="utf-8"))
            return {key: AxisRecord(**fields) for key, fields in document["axes"].items()}
        except FileNotFoundError:
            return {}
        except OSError as exc:
            raise RunError(f"{self._path}: cannot be read: {exc.strerror or exc}") from exc
        except (ValueError, KeyError, TypeError, AttributeError) as exc:
            hint = "look where the arms stand, delete the file, and home the axes"
            raise RunError(f"{self._path}: not the record of the axes' last commands: {exc}; {hint}") from exc


@dataclass(frozen=True)
class AxisMemory:
    """The record of one stage."""

    records: AxisRecords
    identity: str

    def get(self) -> AxisRecord | None:
        """Return what is known; see `AxisRecords.get`."""
        return self.records.get(self.identity)

    def put(self, *, setpoint: float | None, readback: float, under_way: bool, homed: bool) -> None:
        """Write it down; see `AxisRecords.put`."""
        self.records.put(self.identity, setpoint=setpoint, readback=readback, under_way=under_way, homed=homed)


def recollected(name: str, stage: Stage, axis_map: AxisMap, tolerance: float, record: AxisRecord | None) -> tuple[str, ...]:
    """Compare a stage with what was written down of it last, and return what somebody should know before it moves.

    A stage that does not tell whether it was homed is taken as homed where the record says so, the last motion was seen to its end, and it
    stands where it was left.
    """
    if record is None:
        return ()
    state = stage.state()

    def theta(position: float) -> str:
        return f"{axis_map.to_theta(position):.3f} {stage.unit}"

    if record.under_way:
        aim = "homing" if record.setpoint is None else f"on its way to {theta(record.setpoint)}"
        return (f"{name} was {aim} when the last program that moved it ended without seeing the end; it is at {theta(state.position)} now",)
    if abs(state.position - record.readback) > tolerance:
        left, here = theta(record.readback), theta(state.position)
        return (f"{name} was left at {left} and is at {here}: switched off, or moved by somebody else; home it",)
    if isinstance(stage, ForgetfulStage) and not state.homed and record.vouches(state, tolerance):
        stage.trust_reference()
    return ()
