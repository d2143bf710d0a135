"""Simulated Oriental Motor AZ drivers (AZD-KD class) that turn hollow rotary actuators: the registers behind a Modbus RTU address.

Source: the project's protocol sheet, section 4. Points it marks as unverified, and what is done here: the exception code for a start that
the state forbids (settable), writing an identical block again (starts again), the gear (settable), whether HOME-END stays on when the
axis moves on (settable). Not in the sheet, and chosen: registers it does not name are refused as illegal addresses; ZHOME finds an unknown
origin as it would a known one; the software limits count only once the origin is known.

Not simulated: wrap, push and torque operations (alarm 70h), forwarding to the buffer (refused), jogging, D-SEL inputs, the 0x1800 copy of
the operation data. The position sensor sits on the motor, so that the ringing of the table after a stop shows in `AzAxis.track` only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sim import motion
from sim.errors import SimError
from sim.modbus import FAILURE, ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refusal, Unit
from sim.troubles import cut_short

# Inputs of 0x007D and outputs of 0x007F as delivered. Source: sheet 4.3 and 4.4.
START, ZHOME, STOP, FREE, ALM_RST, SSTART, FW_POS, RV_POS = (1 << bit for bit in (3, 4, 5, 6, 7, 11, 14, 15))
HOME_END, READY, ALM_A, MOVE, IN_POS = (1 << bit for bit in (4, 5, 7, 13, 14))

NOT_RESETTABLE = frozenset({0x20, 0x22, 0x28, 0x2A, 0x33, 0x41, 0x42, 0x43, 0x44, 0x45, 0x51, 0x53, 0x71, 0x72, 0x83, 0xF0})
"""Alarms that only a power cycle clears. Source: sheet 4.6, from one reading of the manual."""

NO_ORIGIN, SOFTWARE_OVERTRAVEL, OPERATION_DATA = 0x4A, 0x67, 0x70
_TROUBLES = {"alarm": (0x22, 0x25, 0x26, 0x28, 0x31), "stall": (0x10, 0x30), "limit-hit": (0x60, 0x66)}

_INPUT, _INPUT_PULSE, _OUTPUT, _ALARM, _HISTORY, _COMM_ERROR = 0x7C, 0x78, 0x7E, 0x80, 0x82, 0xAC
_COMMAND_POSITION, _POSITION, _SPEED_RPM, _SPEED_HZ, _TORQUE = (0xC6, 0x120), (0xCC, 0x122), 0xCE, 0xD0, 0xD6
_ALARM_RESET, _CLEAR_HISTORY, _PRESET, _PRESET_VALUE, _TRIGGER, _FORWARD = 0x180, 0x184, 0x18A, 0x38C, 0x66, 0x68
_TEMPERATURES = {0xF8: 310, 0xFA: 295}  # driver and motor, 0.1 deg C
_QUIET_COMMANDS = (0x188, 0x1A0, 0x1A6)  # clear what is not simulated

_FIELDS = {"number": 0x58, "kind": 0x5A, "position": 0x5C, "speed": 0x5E, "rate": 0x60, "stop_rate": 0x62, "current": 0x64}
_TRIGGERED_ALONE = {-1: "current", -2: "stop_rate", -3: "rate", -4: "speed", -5: "position", -6: "kind", -7: "number"}
_STORED = {"position": 0x400, "speed": 0x480, "kind": 0x500, "rate": 0x600, "stop_rate": 0x680, "current": 0x700}
_STORED_COUNT = 64
_WIDE = (-(2**31), 2**31 - 1)
_RANGES = {
    "number": (0, 255),
    "kind": (0, 22),
    "position": _WIDE,
    "speed": (-4_000_000, 4_000_000),
    "rate": (1, 1_000_000_000),
    "stop_rate": (1, 1_000_000_000),
    "current": (0, 1000),
}
_ABSOLUTE, _FROM_COMMAND, _FROM_FEEDBACK, _ENDLESS = 1, 2, 3, (7, 16)


@dataclass(frozen=True)
class AzModel:
    """What an axis is like.

    Parameters
    ----------
    steps_per_turn : int
        Of the table: 1000 a turn of the motor, times the gear, 18 for a DGM85R (unverified).
    limit_min, limit_max : float, deg
        Software limits.
    home_speed : float, deg/s
    home_rate : float, deg/s^2
    origin_known : bool
        Whether the absolute sensor knows the origin at power-up.
    home_end_holds : bool
        Whether HOME-END stays on when the axis moves on (unverified).
    refusal : int
        Exception code for a start that the state forbids (unverified).
    ringing : Ringing
        Of the table, degrees.
    """

    steps_per_turn: int = 18_000
    limit_min: float = 0.0
    limit_max: float = 360.0
    home_speed: float = 30.0
    home_rate: float = 300.0
    origin_known: bool = False
    home_end_holds: bool = True
    refusal: int = FAILURE
    ringing: motion.Ringing = field(default_factory=motion.Ringing)

    def __post_init__(self) -> None:
        if not all(0 < number < math.inf for number in (self.steps_per_turn, self.home_speed, self.home_rate)):
            raise SimError(f"{self}: steps, speed and rate must be above zero")
        if not self.limit_min < self.limit_max:
            raise SimError(f"{self}: limit_min must be below limit_max")


@dataclass(frozen=True)
class Operation:
    """What a motion is told: position in steps, speed in Hz, rates in steps/s^2 (0.001 kHz/s), current in 0.1 %."""

    number: int = 0
    kind: int = _FROM_COMMAND
    position: int = 0
    speed: int = 1000
    rate: int = 1_000_000
    stop_rate: int = 1_000_000
    current: int = 1000


def to_target(position: float, velocity: float, target: float, speed: float, rate: float, stop_rate: float) -> motion.Segments:
    """Plan a move to rest at `target` that speeds up at `rate` and brakes at `stop_rate`."""
    distance = target - position
    excess = distance - velocity * abs(velocity) / (2 * stop_rate)  # what is left if the axis braked now
    if excess == 0:
        return motion.to_rest(velocity, stop_rate)
    way = math.copysign(1.0, excess)
    start, room = way * velocity, way * distance
    if start < 0:  # it turns round: braked like any motion, and started afresh
        turned = position + velocity * abs(velocity) / (2 * stop_rate)
        return (*motion.to_rest(velocity, stop_rate), *to_target(turned, 0.0, target, speed, rate, stop_rate))
    if start > speed:
        first, push = (start - speed) / stop_rate, -stop_rate
        peak = speed
    else:
        energy = (room + start * start / (2 * rate)) * 2 * rate * stop_rate / (rate + stop_rate)
        peak = min(speed, math.sqrt(max(0.0, energy)))
        first, push = (peak - start) / rate, rate
    swept = first * (peak + start) / 2
    cruise = max(0.0, (room - swept - peak * peak / (2 * stop_rate)) / peak) if peak > 0 else 0.0
    pieces = ((first, way * push), (cruise, 0.0), (peak / stop_rate, -way * stop_rate))
    return tuple(piece for piece in pieces if piece[0] > 0)


class AzAxis(Unit):
    """One AZ driver with its actuator; the true angle of the table is in `track` (degrees, zero at the origin).

    `on_stop`, where set, is called at each input word with STOP in it.
    """

    functions = frozenset({3, 6, 8, 16, 23})
    troubles = tuple(_TROUBLES)

    def __init__(self, model: AzModel, angle: float) -> None:
        self.model = model
        self.track = motion.Track(angle, model.ringing)
        self.on_stop: Callable[[], None] | None = None
        self._scale = model.steps_per_turn / 360
        self._cells = {_FORWARD: 0, _TRIGGER: 0, _INPUT: 0, _PRESET_VALUE: 0, _ALARM_RESET: 0, _CLEAR_HISTORY: 0, _PRESET: 0}
        self._cells |= dict.fromkeys(_QUIET_COMMANDS, 0)
        plain = Operation()
        self._cells |= {address: getattr(plain, name) for name, address in _FIELDS.items()}
        self._cells |= {base + 2 * n: getattr(plain, name) for name, base in _STORED.items() for n in range(_STORED_COUNT)}
        self._ranges = {address: _RANGES[name] for name, address in _FIELDS.items()}
        self._ranges |= {base + 2 * n: _RANGES[name] for name, base in _STORED.items() for n in range(_STORED_COUNT)}
        self._ranges |= {_FORWARD: (0, 0), _TRIGGER: (-7, 1)}
        self._history: list[int] = []
        self._zero = 0.0
        self._running = plain
        self.power_up(0.0)

    def power_up(self, t: float) -> None:
        """Take power away and give it back: alarms are gone, and the origin unless the sensor keeps it."""
        self._brake(t, self._running.stop_rate)
        self._origin = self.model.origin_known
        self._zero = 0.0 if self._origin else self.track.nominal(max(t, self.track.end))[0]
        self._home_end = self._homing = False
        self._fails_on_arrival = 0
        self.alarm = 0
        self._cells[_INPUT] = 0

    def fail(self, t: float, code: int) -> None:
        """Raise an alarm, as an overload (30h), a limit sensor (60h) or a lost encoder would: the axis brakes and takes no start."""
        self._brake(t, self._running.stop_rate)
        self.alarm = code
        self._history = [code, *self._history][:10]
        self._homing = False
        self._fails_on_arrival = 0

    def trouble(self, t: float, kind: str, rng: np.random.Generator) -> str | None:
        """Raise a drawn alarm, now or at the place where the motion under way is cut short; see `sim.troubles`."""
        code = _TROUBLES[kind][int(rng.integers(len(_TROUBLES[kind])))]
        self.update(t)
        if kind == "alarm":
            self.fail(t, code)
            return f"alarm {code:02X}h"
        if not self.busy(t):
            return None
        halted, _ = cut_short(self.track, t, rng)
        self._homing, self._fails_on_arrival = False, code
        return f"halts at {round((halted - self._zero) * self._scale)} steps: alarm {code:02X}h"

    def busy(self, t: float) -> bool:
        """Tell whether the axis is moving; the ringing afterwards does not count."""
        return t < self.track.end

    def position(self, t: float) -> int:
        """Return the counter, steps."""
        return round((self.track.nominal(t)[0] - self._zero) * self._scale)

    def outputs(self, t: float) -> int:
        """Return the word at 0x007F."""
        busy, inputs = self.busy(t), self._cells[_INPUT]
        ready = not (busy or self.alarm or inputs & (STOP | FREE))
        word = inputs & 0b111 | inputs & START
        for bit, on in ((HOME_END, self._home_end), (READY, ready), (ALM_A, self.alarm), (MOVE, busy), (IN_POS, not busy)):
            word |= bit if on else 0
        return word

    def update(self, t: float) -> None:
        """Take note of a motion completed by time `t`."""
        if t < self.track.end:
            return
        if self._homing:
            self._homing, self._origin, self._home_end, self._zero = False, True, True, 0.0
        if self._fails_on_arrival:
            self.fail(t, self._fails_on_arrival)

    def read_holding(self, t: float, address: int, count: int) -> Sequence[int]:
        """Return registers: the upper word of each 32-bit number at the lower, even address."""
        self.update(t)
        return [self._value(t, place & ~1) >> (0 if place & 1 else 16) & 0xFFFF for place in range(address, address + count)]

    def _value(self, t: float, address: int) -> int:
        velocity = self.track.nominal(t)[1] * self._scale
        live = {
            _INPUT_PULSE: 0,
            _OUTPUT: self.outputs(t),
            _ALARM: self.alarm,
            _COMM_ERROR: 0,
            _SPEED_HZ: round(velocity),
            _SPEED_RPM: round(velocity * 60 / 1000),  # of the motor: 1000 steps a turn
            _TORQUE: 0,
            0xFC: 0,
            **_TEMPERATURES,
            **dict.fromkeys((*_COMMAND_POSITION, *_POSITION), self.position(t)),
        }
        if address in live:
            return live[address]
        if _HISTORY <= address < _HISTORY + 20:
            place = (address - _HISTORY) // 2
            return self._history[place] if place < len(self._history) else 0
        if address in self._cells:
            return self._cells[address]
        raise Refusal(ILLEGAL_ADDRESS)

    def write_holding(self, t: float, address: int, values: Sequence[int]) -> None:
        """Write registers and do what they ask for; what was written before a refused one stays written."""
        self.update(t)
        words = dict(enumerate(values, address))
        for cell in sorted({place & ~1 for place in words}):
            if cell != _INPUT_PULSE and cell not in self._cells:
                raise Refusal(ILLEGAL_ADDRESS)
            old = self._cells.get(cell, 0)
            high, low = words.get(cell, old >> 16 & 0xFFFF), words.get(cell + 1, old & 0xFFFF)
            value = (high << 16 | low) - ((high & 0x8000) << 17)
            least, most = self._ranges.get(cell, _WIDE)
            if not least <= value <= most:
                raise Refusal(ILLEGAL_VALUE)
            if cell != _INPUT_PULSE:
                self._cells[cell] = value
            self._act(t, cell, old, value, cell + 1 in words)

    def _act(self, t: float, cell: int, old: int, value: int, low_word: bool) -> None:
        rises = value == 1 and old != 1
        if cell in (_INPUT, _INPUT_PULSE) and low_word and value & STOP and self.on_stop is not None:
            self.on_stop()
        if cell == _TRIGGER and low_word and value:
            self._trigger(t, value)
        elif cell == _INPUT:
            self._input(t, value & ~old & 0xFFFF, value)
        elif cell == _INPUT_PULSE:
            self._input(t, value & 0xFFFF, value | self._cells[_INPUT])
        elif cell == _ALARM_RESET and rises:
            self._reset_alarm()
        elif cell == _CLEAR_HISTORY and rises:
            self._history = []
        elif cell == _PRESET and rises:
            if self.busy(t):
                raise Refusal(self.model.refusal)
            self._zero = self.track.nominal(t)[0] - self._cells[_PRESET_VALUE] / self._scale
            self._origin = self._home_end = True

    def _reset_alarm(self) -> None:
        if self.alarm not in NOT_RESETTABLE:
            self.alarm = 0

    def _trigger(self, t: float, trigger: int) -> None:
        """Start the direct data operation, with all its fields or with one of them changed. Source: sheet 4.2."""
        fields = {name: self._cells[address] for name, address in _FIELDS.items()}
        name = _TRIGGERED_ALONE.get(trigger)
        if self.alarm or self._cells[_INPUT] & (STOP | FREE):
            raise Refusal(self.model.refusal)
        self._start(t, Operation(**fields) if name is None else replace(self._running, **{name: fields[name]}))

    def _input(self, t: float, rising: int, inputs: int) -> None:
        if rising & ALM_RST:
            self._reset_alarm()
        if rising & (STOP | FREE):
            self._brake(t, self._running.stop_rate)
            self._homing, self._fails_on_arrival = False, 0
        if self.alarm or inputs & (STOP | FREE):
            return
        if rising & (START | SSTART):
            number = inputs & 0b111
            self._start(t, Operation(number, **{name: self._cells[base + 2 * number] for name, base in _STORED.items()}))
        elif rising & ZHOME:
            self._home(t)
        elif rising & (FW_POS | RV_POS):
            stored = {name: self._cells[base + 2 * (inputs & 0b111)] for name, base in _STORED.items()}
            speed = abs(stored["speed"]) * (1 if rising & FW_POS else -1)
            self._start(t, Operation(**{**stored, "kind": _ENDLESS[0], "speed": speed}))

    def _home(self, t: float) -> None:
        position, velocity = self.track.nominal(t)
        self._begin(t, motion.to_target(position, velocity, 0.0, self.model.home_speed, self.model.home_rate))
        self._home_end, self._homing = False, True

    def _start(self, t: float, operation: Operation) -> None:
        position, velocity = self.track.nominal(t)
        speed, rate, stop_rate = (number / self._scale for number in (abs(operation.speed), operation.rate, operation.stop_rate))
        low, high = (self._zero + limit for limit in (self.model.limit_min, self.model.limit_max))
        if operation.kind not in (_ABSOLUTE, _FROM_COMMAND, _FROM_FEEDBACK, *_ENDLESS) or operation.speed == 0:
            self.fail(t, OPERATION_DATA)
            return
        if operation.kind in _ENDLESS:
            if self._origin:
                self._begin(t, to_target(position, velocity, high if operation.speed > 0 else low, speed, rate, stop_rate))
                self._fails_on_arrival = SOFTWARE_OVERTRAVEL
            else:
                self._begin(t, motion.to_velocity(velocity, math.copysign(speed, operation.speed), rate))
        elif operation.kind == _ABSOLUTE and not self._origin:
            self.fail(t, NO_ORIGIN)
            return
        else:
            target = operation.position / self._scale + (self._zero if operation.kind == _ABSOLUTE else position)
            if self._origin and not low - 1e-9 <= target <= high + 1e-9:
                self.fail(t, SOFTWARE_OVERTRAVEL)
                return
            self._begin(t, to_target(position, velocity, target, speed, rate, stop_rate))
        self._running = operation

    def _begin(self, t: float, segments: motion.Segments) -> None:
        self._homing, self._fails_on_arrival = False, 0
        self._home_end = self._home_end and self.model.home_end_holds
        self.track.begin(t, segments)

    def _brake(self, t: float, rate: float) -> None:
        if self.busy(t):
            self.track.begin(t, motion.to_rest(self.track.nominal(t)[1], rate / self._scale))
