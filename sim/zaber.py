"""Simulated Zaber stages, rotary (X-RSW) or linear (X-LSM): a chain of one-axis devices that speak Zaber's ASCII protocol on one port.

Source: Zaber ASCII Protocol Manual, as condensed in the project's protocol sheet, section 1. Points the sheet marks as unverified, and what
is done here: device and peripheral ids (settable, the defaults are placeholders), the scale of `accel` (1.6384/10000 x usteps/s^2), a
command with a bad checksum (ignored), device-scope settings asked for on an axis (DEVICEONLY), the position shown before homing (0), the
flags shown before homing (settable), commands split over several packets (BADCOMMAND). Of linear
stages, unverified: the microstep (settable, a usual size), `limit.cycle.dist` (BADCOMMAND, since nothing turns), and what happens at the
end of the travel when there is no reference (the carriage stops there with FS). Of troubles, unverified: FS and FE are forgotten with
`warnings clear` and leave the reference, and a disabled driver (FO) refuses motion until `driver enable` or `system reset`.

The stages have no encoder: `pos` is the commanded microstep, and the ringing of the mechanics after a stop shows in `Axis.track` only.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sim import motion
from sim.clock import Clock
from sim.errors import SimError
from sim.troubles import cut_short
from sim.wire import Line, Splitter

VELOCITY_SCALE = 1.6384
"""Velocity data per microstep/s."""
ACCELERATION_SCALE = 1.6384e-4
"""Acceleration data per microstep/s^2 (unverified)."""
LONGEST_PACKET = 80

# Highest priority first: faults, warnings, notes.
_FLAGS = tuple(
    "FF FN FZ FH FV FO FD FC FM FQ FI FA FR FS FB FP FE FT WL WV WT WS WM WP WR WH NC NI ND NR NT NU NJ NB".split(" ")  # noqa: SIM905
)
_CLEARABLE = frozenset({"NI", "FS", "FE"})
_TROUBLES = {"alarm": "FO", "stall": "FS", "limit-hit": "FE"}
_NUMBER = re.compile(r"-?[0-9]{1,12}")
_COUNT = re.compile(r"[0-9]+")


def checksum(text: bytes) -> int:
    """Return the LRC of the bytes between the leading sign and the colon: (-sum) & 0xFF. Source: sheet 1.3."""
    return -sum(text) & 0xFF


class _Reject(Exception):
    """The reason of an RJ reply. Source: sheet 1.4."""


@dataclass(frozen=True, kw_only=True)
class AxisModel:
    """What is to be told of any stage; lengths in its unit, degrees or mm, speeds per second.

    Parameters
    ----------
    limit_min, limit_max : float
        Travel after homing.
    speed, acceleration, top_speed : float
        Defaults of `maxspeed` and `accel`, and the highest speed accepted, raised to `speed` if that is faster.
    home_speed, creep_speed : float
        Homing runs fast to just beside the index and creeps onto it.
    ringing : Ringing
        Of the mechanics.
    device_id, peripheral_id, firmware, build
        Identity. The numbers of real stages are unverified: these are placeholders.
    unhomed_flags : tuple of str
        Warning flags shown until homed. The protocol knows WR and WH; which of them, or both, is unverified.
    """

    name: ClassVar[str]
    """Of the model, as in catalogues."""

    limit_min: float
    limit_max: float
    speed: float
    acceleration: float
    top_speed: float
    home_speed: float
    creep_speed: float
    ringing: motion.Ringing
    device_id: int = 99_999
    peripheral_id: int = 0
    firmware: str = "7.30"
    build: int = 1
    unhomed_flags: tuple[str, ...] = ("WR",)

    @property
    def steps_per_unit(self) -> float:
        """Microsteps per degree or mm at the default resolution of 64."""
        raise NotImplementedError

    @property
    def ends(self) -> tuple[float, float]:
        """Where the mechanics end, true positions."""
        return -math.inf, math.inf

    def __post_init__(self) -> None:
        positive = (self.steps_per_unit, self.speed, self.acceleration, self.top_speed, self.home_speed, self.creep_speed)
        if not all(0 < number < math.inf for number in positive) or not self.limit_min < self.limit_max:
            raise SimError(f"{self}: speeds, acceleration and microsteps must be above zero, and limit_min below limit_max")


@dataclass(frozen=True, kw_only=True)
class StageModel(AxisModel):
    """A rotary stage, degrees; X-RSW60A class, 115 deg/s at most (X-RSW60A-E03).

    Parameters
    ----------
    steps_per_turn : int
        Microsteps per turn at the default resolution of 64.
    """

    name: ClassVar[str] = "zaber-x-rsw60a"

    steps_per_turn: int = 1_536_000
    limit_min: float = 0.0
    limit_max: float = 360.0
    speed: float = 60.0
    acceleration: float = 600.0
    top_speed: float = 115.0
    home_speed: float = 30.0
    creep_speed: float = 2.0
    ringing: motion.Ringing = field(default_factory=motion.Ringing)

    @property
    def steps_per_unit(self) -> float:
        """Microsteps per degree."""
        return self.steps_per_turn / 360


@dataclass(frozen=True, kw_only=True)
class LinearModel(AxisModel):
    """A linear stage, mm; X-LSM class. All numbers are usual ones, and unverified.

    Parameters
    ----------
    microstep : float
        um in a microstep at the default resolution of 64.
    slack : float
        The carriage meets its ends so far beyond the travel, mm.
    """

    name: ClassVar[str] = "zaber-x-lsm"

    microstep: float = 0.047625
    limit_min: float = 0.0
    limit_max: float = 150.0
    speed: float = 20.0
    acceleration: float = 200.0
    top_speed: float = 104.0
    home_speed: float = 20.0
    creep_speed: float = 2.0
    slack: float = 0.5
    ringing: motion.Ringing = field(default_factory=lambda: motion.Ringing(amplitude=0.002))

    def __post_init__(self) -> None:
        if not 0 < self.microstep < math.inf or self.slack < 0:
            raise SimError(f"{self}: expected a microstep above zero, and slack that is not below")
        super().__post_init__()

    @property
    def steps_per_unit(self) -> float:
        """Microsteps per mm."""
        return 1000 / self.microstep

    @property
    def ends(self) -> tuple[float, float]:
        """Where the carriage meets its ends, mm from the home sensor."""
        return self.limit_min - self.slack, self.limit_max + self.slack


class Axis:
    """One axis: counter, settings, flags, and the true position of its arm or carriage in `track` (degrees or mm, zero at the index)."""

    def __init__(self, model: AxisModel, position: float) -> None:
        self._model = model
        self.track = motion.Track(position, model.ringing)
        self.flags: set[str] = set()
        self._zero = position  # where the counter reads zero
        self._homing = False
        self._referenced = False
        self._tells_arrival = False
        self._ends_with: str | None = None  # flag that the motion under way will end in
        scale = model.steps_per_unit
        self.settings = {
            "limit.min": round(model.limit_min * scale),
            "limit.max": round(model.limit_max * scale),
            "limit.home.pos": 0,
            **({"limit.cycle.dist": model.steps_per_turn} if isinstance(model, StageModel) else {}),
            "maxspeed": round(model.speed * scale * VELOCITY_SCALE),
            "accel": round(model.acceleration * scale * ACCELERATION_SCALE),
            "resolution": 64,
            "peripheralid": model.peripheral_id,
        }
        if self.settings["maxspeed"] < 1 or self.settings["accel"] < 1:
            raise SimError(f"{model}: speed or acceleration is less than the protocol's smallest step")
        self.power_up(0.0)

    @property
    def _scale(self) -> float:
        """Microsteps per degree or mm."""
        return self._model.steps_per_unit * self.settings["resolution"] / 64

    def power_up(self, t: float) -> None:
        """Forget the reference; the arm brakes and stays where it is, and the counter reads 0 there."""
        if self.busy(t):
            self.track.begin(t, motion.to_rest(self.track.nominal(t)[1], self._acceleration()))
        self._zero = self.track.nominal(max(t, self.track.end))[0]
        self._homing = self._referenced = self._tells_arrival = False
        self._ends_with = None
        self.flags = set(self._model.unhomed_flags)

    def update(self, t: float) -> None:
        """Take note of what ended by time `t`: a homing, or a motion that was halted."""
        if self._ends_with is not None and t >= self.track.end:
            self.flags.add(self._ends_with)
            self._ends_with = None
        if self._homing and t >= self.track.end:
            self._homing, self._referenced = False, True
            self._zero = -self.settings["limit.home.pos"] / self._scale
            self.flags -= {"WR", "WH"}

    def busy(self, t: float) -> bool:
        """Tell whether the axis is moving; the ringing afterwards does not count."""
        return t < self.track.end

    def position(self, t: float) -> int:
        """Return the counter, microsteps."""
        return round((self.track.nominal(t)[0] - self._zero) * self._scale)

    def flag(self) -> str:
        """Return the flag of highest priority, or `--`."""
        return min(self.flags, key=_FLAGS.index) if self.flags else "--"

    def arrived(self, t: float) -> bool:
        """Tell, once per motion, that it has ended."""
        done = self._tells_arrival and not self.busy(t)
        if done:
            self._tells_arrival = False
        return done

    @property
    def arrival(self) -> float:
        """When the motion under way ends, s; infinite if none that was not told."""
        return self.track.end if self._tells_arrival else math.inf

    def _acceleration(self, data: int | None = None) -> float:
        return (self.settings["accel"] if data is None else data) / ACCELERATION_SCALE / self._scale

    def _speed(self, data: int) -> float:
        return data / VELOCITY_SCALE / self._scale

    def _begin(self, t: float, segments: motion.Segments) -> None:
        if self.busy(t):
            self.flags.add("NI")
        self._homing, self._ends_with = False, None
        self.track.begin(t, segments)
        self._tells_arrival = True

    def halt(self, t: float, flag: str, rng: np.random.Generator) -> float:
        """Plan that the motion under way ends dead and shows `flag`, a stall or a limit sensor; return the position, microsteps."""
        halted, _ = cut_short(self.track, t, rng)
        self._homing, self._ends_with = False, flag
        return round((halted - self._zero) * self._scale)

    def disable(self, t: float) -> None:
        """Take the current from the motor: the axis stops dead and refuses motion."""
        if self.busy(t):
            self._begin(t, ())
        self.flags.add("FO")

    def enable(self) -> None:
        """Give the motor its current again: `driver enable`."""
        self.flags.discard("FO")

    def _enabled(self) -> None:
        if "FO" in self.flags:
            raise _Reject("DRIVERDISABLED")

    def stop(self, t: float) -> None:
        """Brake to rest: `stop`."""
        self._begin(t, motion.to_rest(self.track.nominal(t)[1], self._acceleration()))

    def home(self, t: float) -> None:
        """Find the index: `home`."""
        self._enabled()
        position, velocity = self.track.nominal(t)
        creep = self._speed(round(self._model.creep_speed * self._scale * VELOCITY_SCALE))
        fast = min(self._model.home_speed, self._speed(self.settings["maxspeed"]))
        beside = motion.to_target(position, velocity, 1.0, fast, self._acceleration())
        self._begin(t, (*beside, *motion.to_target(1.0, 0.0, 0.0, creep, self._acceleration())))
        self._homing = True

    def move(self, t: float, kind: str, arguments: Sequence[str]) -> None:
        """Start `move abs|rel|vel|max|min`, native units, optional speed and acceleration. Source: sheet 1.6.

        Raises
        ------
        _Reject
            BADDATA for a target beyond the limits, an absolute target without reference, or data out of range; DRIVERDISABLED.
        """
        takes = {"abs": 1, "rel": 1, "vel": 1, "max": 0, "min": 0}.get(kind)
        if takes is None:
            raise _Reject("BADCOMMAND")
        optional = 1 if kind == "vel" else 2
        if not takes <= len(arguments) <= takes + optional:
            raise _Reject("BADCOMMAND" if len(arguments) > takes + optional else "BADDATA")
        data = [_integer(word) for word in arguments]
        self._enabled()
        extras = data[takes:]
        if kind == "vel":
            speed_data, accel_data = abs(data[0]), extras[0] if extras else self.settings["accel"]
        else:
            speed_data = extras[0] if extras else self.settings["maxspeed"]
            accel_data = extras[1] if len(extras) > 1 else self.settings["accel"]
        self._check("accel", accel_data)
        if kind == "vel" and data[0] == 0:
            self._begin(t, motion.to_rest(self.track.nominal(t)[1], self._acceleration(accel_data)))
            return
        self._check("maxspeed", speed_data)
        speed, acceleration = self._speed(speed_data), self._acceleration(accel_data)
        position, velocity = self.track.nominal(t)
        if kind == "vel" and not self._referenced:
            target = math.copysign(math.inf, data[0])
        else:
            target = self._zero + self._target(t, kind, data) / self._scale
        low, high = self._model.ends
        reachable = min(max(target, low), high)
        if math.isinf(reachable):  # a rotary stage without reference turns for ever
            self._begin(t, motion.to_velocity(velocity, math.copysign(speed, data[0]), acceleration))
            return
        self._begin(t, motion.to_target(position, velocity, reachable, speed, acceleration))
        self._ends_with = None if reachable == target else "FS"

    def _target(self, t: float, kind: str, data: Sequence[int]) -> int:
        low, high = self.settings["limit.min"], self.settings["limit.max"]
        if kind == "rel":
            target = self.position(t) + data[0]
        elif kind == "abs":
            target = data[0]
        else:
            target = high if kind == "max" or (kind == "vel" and data[0] > 0) else low
        if not self._referenced and kind != "rel":
            raise _Reject("BADDATA")
        if self._referenced and not low <= target <= high:
            raise _Reject("BADDATA")
        return target

    def _check(self, name: str, number: int) -> None:
        model = self._model
        highest = {
            "maxspeed": round(max(model.top_speed, model.speed) * self._scale * VELOCITY_SCALE),
            "accel": 2**31 - 1,
            "resolution": 256,
        }[name]
        if not 1 <= number <= highest:
            raise _Reject("BADDATA")

    def get(self, t: float, name: str) -> str:
        """Return a setting of axis scope.

        Raises
        ------
        _Reject
            BADCOMMAND for a setting the axis does not have.
        """
        if name == "pos":
            return str(self.position(t))
        if name not in self.settings:
            raise _Reject("BADCOMMAND")
        return str(self.settings[name])

    def set(self, t: float, name: str, word: str) -> None:
        """Change a setting of axis scope.

        Raises
        ------
        _Reject
            BADCOMMAND for a setting that is not there or cannot be written, BADDATA for data out of range, STATUSBUSY while moving where
            the setting cannot be changed under way.
        """
        if name != "pos" and (name not in self.settings or name in ("limit.cycle.dist", "peripheralid")):
            raise _Reject("BADCOMMAND")
        number = _integer(word)
        if name in ("pos", "resolution", "limit.home.pos") and self.busy(t):
            raise _Reject("STATUSBUSY")
        if name == "pos":
            self._zero = self.track.nominal(t)[0] - number / self._scale
        elif name == "limit.home.pos":
            self.settings[name] = number
        elif name in ("limit.min", "limit.max"):
            limits = {key: self.settings[key] for key in ("limit.min", "limit.max")} | {name: number}
            if limits["limit.min"] > limits["limit.max"]:
                raise _Reject("BADDATA")
            self.settings[name] = number
        else:
            self._check(name, number)
            if name == "resolution":
                self._change_resolution(t, number)
            self.settings[name] = number

    def _change_resolution(self, t: float, resolution: int) -> None:
        """Scale all that counts in microsteps; the reference is lost."""
        old = self.settings["resolution"]
        for name in ("limit.min", "limit.max", "limit.home.pos", "limit.cycle.dist", "maxspeed", "accel"):
            if name in self.settings:
                self.settings[name] = round(self.settings[name] * resolution / old)
        self._referenced = False
        self.flags |= set(self._model.unhomed_flags)

    def warnings(self, clear: bool) -> str:
        """Return count and flags, `01 WR`; then forget those that can be cleared."""
        shown = sorted(self.flags, key=_FLAGS.index)
        if clear:
            self.flags -= _CLEARABLE
        return " ".join([f"{len(shown):02d}", *shown])


def _integer(word: str) -> int:
    if not _NUMBER.fullmatch(word):
        raise _Reject("BADDATA")
    return int(word)


@dataclass
class _Device:
    address: int
    axis: Axis
    serial: int
    alert: int = 0
    checksum: int = 0


@dataclass(frozen=True)
class Command:
    """A command taken apart: addresses, message id (two digits, `--` or none), words, and whether it carried a checksum."""

    device: int
    axis: int
    id: str | None
    words: tuple[str, ...]
    checked: bool


def parse(packet: bytes) -> Command | None:
    """Take a command packet apart; None for noise and for a bad checksum, which a device ignores. Source: sheet 1.2 and 1.3.

    Whatever stands before the last `/` is noise on the line.
    """
    _, slash, text = packet.rpartition(b"/")
    if not slash:
        return None
    body, colon, check = text.partition(b":")
    if colon and (not re.fullmatch(rb"[0-9A-Fa-f]{2}", check.strip()) or int(check, 16) != checksum(body)):
        return None
    words = body.decode("latin-1").split(" ")
    words = [word for word in words if word]
    numbers: list[int] = []
    for highest in (99, 9):
        if not words or not _COUNT.fullmatch(words[0]):
            break
        if len(words[0]) > 4 or int(words[0]) > highest:
            return None
        numbers.append(int(words.pop(0)))
    id_ = None
    if len(numbers) == 2 and words and (words[0] == "--" or _COUNT.fullmatch(words[0])):
        id_ = words.pop(0)
    device, axis = (*numbers, 0, 0)[:2]
    return Command(device, axis, id_, tuple(words), bool(colon))


class ZaberChain:
    """A chain of stages on one port, addresses 1 to N.

    `on_stop`, where set, is told the place in the chain (from 1) of each stage that is told to `stop`.

    Parameters
    ----------
    clock : Clock
        Simulated time.
    positions : sequence of float
        Where each stage stands when power comes, true degrees or mm from its index.
    model : AxisModel
        All stages are alike.
    name : str
        Of the port.
    """

    troubles = tuple(_TROUBLES)

    def __init__(self, clock: Clock, positions: Sequence[float], model: AxisModel | None = None, name: str = "stages") -> None:
        if not 1 <= len(positions) <= 99:
            raise SimError(f"a chain of {len(positions)} stages: expected 1 to 99")
        self.name = name
        self.stage = model or StageModel()
        self.model = self.stage.name
        self.on_stop: Callable[[str], None] | None = None
        self._clock = clock
        self._devices = [_Device(i + 1, Axis(self.stage, position), 10_001 + i) for i, position in enumerate(positions)]
        self._lines: set[Line] = set()
        self._herald: asyncio.Task[None] | None = None

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes in the order of the chain."""
        return tuple(device.axis for device in self._devices)

    async def serve(self, line: Line) -> None:
        """Answer commands and send alerts on `line` until the client has gone."""
        splitter = Splitter(LONGEST_PACKET)
        self._lines.add(line)
        try:
            while data := await line.read():
                for packet in splitter.feed(data):
                    for reply in self.answer(packet):
                        line.write(reply)
                    self._watch()
                await line.drain()
        finally:
            self._lines.discard(line)
            if not self._lines and self._herald is not None:
                self._herald.cancel()

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Disable the driver of a drawn axis, or have one that moves halt; see `sim.troubles`."""
        now, flag = self._clock.now(), _TROUBLES[kind]
        devices = [device for device in self._devices if kind == "alarm" or device.axis.busy(now)]
        if not devices:
            return None
        device = devices[int(rng.integers(len(devices)))]
        device.axis.update(now)
        if kind == "alarm":
            device.axis.disable(now)
            return f"device {device.address} shows {flag}"
        return f"device {device.address} halts at {device.axis.halt(now, flag, rng)} microsteps and shows {flag}"

    def _next_arrival(self) -> float:
        return min(device.axis.arrival for device in self._devices)

    def _watch(self) -> None:
        """Have arrivals told; anew after each command, which may have moved them."""
        if self._herald is not None:
            self._herald.cancel()
        self._herald = asyncio.get_running_loop().create_task(self._announce()) if self._next_arrival() < math.inf else None

    async def _announce(self) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            while (arrival := self._next_arrival()) < math.inf:
                await self._clock.sleep_until(arrival)
                for alert in self.alerts():
                    for line in self._lines:
                        line.write(alert)

    def alerts(self) -> list[bytes]:
        """Return the alerts due: one for each motion ended since the last call, from devices with `comm.alert` on."""
        now = self._clock.now()
        told = []
        for device in self._devices:
            device.axis.update(now)
            if device.axis.arrived(now) and device.alert:
                told.append(_packet("!", f"{device.address:02d} 1 IDLE {device.axis.flag()}", bool(device.checksum)))
        return told

    def answer(self, packet: bytes) -> list[bytes]:
        """Carry out one command packet and return the replies of every device it addresses, in the order of the chain."""
        command = parse(packet)
        if command is None:
            return []
        now = self._clock.now()
        replies = []
        addressed = [device for device in self._devices if command.device in (0, device.address)]
        for place, device in enumerate(addressed):
            device.axis.update(now)
            checked = command.checked or bool(device.checksum)
            id_ = command.id if command.id is not None and len(command.id) == 2 else None
            try:
                if command.axis > 1:
                    raise _Reject("BADAXIS")
                if command.id is not None and id_ is None:
                    raise _Reject("BADMESSAGEID")
                verdict, data = "OK", self._execute(device, place, command, now)
            except _Reject as reason:
                verdict, data = "RJ", str(reason)
            if id_ == "--":
                continue
            head = f"{device.address:02d} {command.axis}" + (f" {id_}" if id_ else "")
            status = "BUSY" if device.axis.busy(now) else "IDLE"
            replies.append(_packet("@", f"{head} {verdict} {status} {device.axis.flag()} {data}", checked))
        return replies

    def _execute(self, device: _Device, place: int, command: Command, now: float) -> str:
        axis = device.axis
        match command.words:
            case ():
                pass
            case ("home",):
                axis.home(now)
            case ("stop",):
                axis.stop(now)
                if self.on_stop is not None:
                    self.on_stop(str(self.axes.index(axis) + 1))
            case ("driver", "enable"):
                axis.enable()
            case ("move", kind, *arguments):
                axis.move(now, kind, arguments)
            case ("get", name):
                return self._get(device, command.axis, name, now)
            case ("set", name, word):
                self._set(device, command.axis, name, word, now)
            case ("set", _):
                raise _Reject("BADDATA")
            case ("warnings",) | ("warnings", "clear"):
                return axis.warnings(clear=len(command.words) == 2)
            case ("renumber", *arguments) if len(arguments) <= 1:
                self._renumber(device, place, command, arguments)
            case ("system", "reset"):
                _device_scope(command.axis)
                axis.power_up(now)
            case _:
                raise _Reject("BADCOMMAND")
        return "0"

    def _get(self, device: _Device, axis: int, name: str, now: float) -> str:
        values = {
            "deviceid": self.stage.device_id,
            "system.serial": device.serial,
            "version": self.stage.firmware,
            "version.build": self.stage.build,
            "system.axiscount": 1,
            "comm.address": device.address,
            "comm.alert": device.alert,
            "comm.checksum": device.checksum,
            "comm.packet.size.max": LONGEST_PACKET,
        }
        if name not in values:
            return device.axis.get(now, name)
        _device_scope(axis)
        return str(values[name])

    @staticmethod
    def _set(device: _Device, axis: int, name: str, word: str, now: float) -> None:
        if name not in ("comm.alert", "comm.checksum"):
            device.axis.set(now, name, word)
            return
        _device_scope(axis)
        if word not in ("0", "1"):
            raise _Reject("BADDATA")
        if name == "comm.alert":
            device.alert = int(word)
        else:
            device.checksum = int(word)

    @staticmethod
    def _renumber(device: _Device, place: int, command: Command, arguments: Sequence[str]) -> None:
        """Give addresses: to all devices, upwards along the chain; to one, the address named."""
        _device_scope(command.axis)
        if command.device and not arguments:
            raise _Reject("BADDATA")
        address = (_integer(arguments[0]) if arguments else 1) + (place if command.device == 0 else 0)
        if not 1 <= address <= 99:
            raise _Reject("BADDATA")
        device.address = address


def _device_scope(axis: int) -> None:
    if axis:
        raise _Reject("DEVICEONLY")


def _packet(sign: str, text: str, checked: bool) -> bytes:
    body = text.encode("ascii")
    return sign.encode() + body + (f":{checksum(body):02X}".encode() if checked else b"") + b"\r\n"
