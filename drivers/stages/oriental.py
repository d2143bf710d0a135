"""Oriental Motor AZ drivers (AZD-KD, -CD, -AD) with hollow rotary actuators over Modbus RTU.

Source: Oriental Motor's AZ register map, as open drivers quote it from manuals HM-60252J and HM-60262E. A move is one write of the
direct data operation from 0x0058, the trigger last; home and stop are bits of the driver input command at 0x007D, which acts on rising
edges. The registers say neither serial number, firmware nor limits.

Not verified on hardware, and therefore options: the gear (`steps_per_degree`), which input starts homing (`home_bit`), and whether
HOME-END stays on when the axis moves on (`home_end_holds`). Also not verified, and not relied on: whether writing an identical block again
starts again (a motion is never sent twice), the exception code of a refused start, which alarms can be cleared by command.
"""

from __future__ import annotations

import math
from typing import Literal

from drivers.endpoint import Veto
from drivers.errors import DeviceFault, InvalidSetting, NotHomed
from drivers.kinds import AxisState, Identity, MotionProfile
from drivers.link import Link
from drivers.modbus import ModbusUnit
from drivers.motion import Stops, require_arrival

STEPS_PER_DEGREE = 50.0
"""0.02 deg a step: 1000 steps a turn of the motor and the 18:1 gear of a DGM85R or DGM130R. The gear is unverified: hence an option."""

ZHOME_BIT = 4
"""High-speed return to home among the inputs as delivered; they can be assigned otherwise: hence an option."""

ALARMS = {
    0x10: "excessive position deviation",
    0x20: "overcurrent",
    0x21: "main circuit overheat",
    0x22: "overvoltage",
    0x23: "main power off",
    0x25: "undervoltage",
    0x26: "motor overheat",
    0x28: "sensor error",
    0x2A: "absolute sensor communication error",
    0x30: "overload",
    0x31: "overspeed",
    0x33: "absolute position error",
    0x34: "command pulse error",
    0x41: "EEPROM error",
    0x42: "sensor or motor error at power-up",
    0x43: "sensor or motor error at power-up",
    0x44: "sensor or motor error at power-up",
    0x45: "sensor or motor error at power-up",
    0x4A: "return to home incomplete",
    0x60: "both limit sensors on",
    0x61: "homing error",
    0x62: "homing error",
    0x63: "homing error",
    0x64: "homing error",
    0x66: "hardware overtravel",
    0x67: "software overtravel",
    0x68: "hardware torque-off input (HWTO)",
    0x6D: "mechanical overtravel",
    0x70: "operation data error",
    0x71: "gear setting error",
    0x72: "wrap setting error",
    0x81: "bus error",
    0x83: "switch setting error",
    0x84: "RS-485 communication error",
    0x85: "RS-485 communication time-out",
    0xF0: "CPU error",
}
"""Alarm codes and what they are called, shortened; codes without a name in the map's sources are left out."""

_OPERATION, _INPUT, _OUTPUT, _POSITION, _ALARM_RESET = 0x0058, 0x007D, 0x007E, 0x00CC, 0x0180
_ABSOLUTE, _ALL_FIELDS, _FULL_CURRENT = 1, 1, 1000
_STOP = 1 << 5
_HOME_END, _READY, _INFO, _ALARM, _MOVE = (1 << bit for bit in (4, 5, 6, 7, 13))
_FASTEST_HZ, _STEEPEST = 4_000_000, 1_000_000_000
_RETURN_INCOMPLETE = 0x4A


class OrientalAxis:
    """One axis; satisfies `drivers.kinds.Stage`. Several may share a link, each at its own address.

    Parameters
    ----------
    link : ModbusLink
        Stays the caller's to close.
    name : str
        For messages.
    address : int
        Set on the driver's rotary switch, 1 to 31.
    steps_per_degree : float
        Scale; the default is unverified.
    limits : tuple of float, deg
        Lower and upper end of travel, which the registers do not tell: a move beyond is refused here. Set the same in the driver.
    profile : MotionProfile
        Sent along with every move; the driver keeps none of its own.
    home_bit : int
        Input that starts homing.
    home_end_holds : bool
        Whether HOME-END stays on when the axis moves on. If not, having seen it once is enough, until an alarm says otherwise.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        *,
        address: int = 1,
        steps_per_degree: float = STEPS_PER_DEGREE,
        limits: tuple[float, float] = (0.0, 360.0),
        profile: MotionProfile | None = None,
        home_bit: int = ZHOME_BIT,
        home_end_holds: bool = True,
    ) -> None:
        if not (math.isfinite(steps_per_degree) and steps_per_degree > 0):
            raise InvalidSetting(f"steps_per_degree {steps_per_degree}", device=name, expected="a finite number above 0")
        if not (math.isfinite(limits[0]) and math.isfinite(limits[1]) and limits[0] < limits[1]):
            raise InvalidSetting(f"limits {limits}", device=name, expected="two finite angles, the lower first")
        if not (0 <= home_bit <= 15 and home_bit != 5):
            raise InvalidSetting(f"home_bit {home_bit}", device=name, expected="0 to 15, and not 5, which stops")
        self._unit = ModbusUnit(link, name, address)
        self._scale = steps_per_degree
        self._limits = limits
        self._home = 1 << home_bit
        self._home_end_holds = home_end_holds
        self._was_home = False
        self._profile = MotionProfile(20.0, 100.0)
        self._stops = Stops()
        self._input_left_on = False
        if profile is not None:
            self.set_profile(profile.speed, profile.acceleration)

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        address: int = 1,
        steps_per_degree: float = STEPS_PER_DEGREE,
        limit_min_deg: float = 0.0,
        limit_max_deg: float = 360.0,
        speed: float = 20.0,
        acceleration: float = 100.0,
        home_bit: int = ZHOME_BIT,
        home_end_holds: bool = True,
    ) -> OrientalAxis:
        """Meet the driver. Nothing moves.

        Raises
        ------
        DeviceError
            It does not answer.
        """
        axis = cls(
            link,
            name,
            address=address,
            steps_per_degree=steps_per_degree,
            limits=(limit_min_deg, limit_max_deg),
            profile=MotionProfile(speed, acceleration),
            home_bit=home_bit,
            home_end_holds=home_end_holds,
        )
        axis._unit.echo()
        return axis

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._unit.name

    @property
    def unit(self) -> Literal["deg"]:
        """What it counts in."""
        return "deg"

    def identify(self) -> Identity:
        """Make sure that it is there; its registers tell neither model, serial number nor firmware."""
        self._unit.echo("looking who is there")
        return Identity("Oriental Motor", f"AZ at address {self._unit.address}", "not told over Modbus", "not told over Modbus")

    def state(self) -> AxisState:
        """Ask for outputs and alarm, and then for the position: at rest, it is the one it rests at."""
        outputs, alarm = self._outputs("reading the state")
        (steps,) = self._unit.int32(self._unit.holding(_POSITION, 2, "reading the position"))
        return AxisState(
            position=steps / self._scale,
            moving=bool(outputs & _MOVE),
            homed=self._homed(outputs, alarm),
            warnings=(f"ALARM {alarm:02X}",) if outputs & _ALARM else ("INFO",) if outputs & _INFO else (),
        )

    def limits(self) -> tuple[float, float]:
        """Lower and upper limit as configured, deg: the registers do not tell."""
        return self._limits

    def profile(self) -> MotionProfile:
        """Speed and acceleration that go along with every move."""
        return self._profile

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None:
        """Set speed (deg/s), acceleration (deg/s^2) or both for the moves to come, to the nearest value that can be sent.

        Raises
        ------
        InvalidSetting
            A value is not finite, or cannot be sent.
        """
        speed = self._profile.speed if speed is None else speed
        acceleration = self._profile.acceleration if acceleration is None else acceleration
        numbers = []
        for what, value, most in (("speed in deg/s", speed, _FASTEST_HZ), ("acceleration in deg/s^2", acceleration, _STEEPEST)):
            if not (math.isfinite(value) and 1 <= round(value * self._scale) <= most):
                expected = f"{1 / self._scale:.3g} to {most / self._scale:.3g}"
                raise InvalidSetting(f"{what} {value}", device=self.name, attempt="setting the motion profile", expected=expected)
            numbers.append(round(value * self._scale) / self._scale)
        self._profile = MotionProfile(*numbers)

    def start_home(self) -> None:
        """Start homing. When it is over, `state` says ``homed``.

        Raises
        ------
        DeviceFault
            There is an alarm, or the driver is not ready; or `stop` came between.
        """
        attempt = "starting to home"
        veto = self._stops.veto(self._unit, attempt)
        self._make_ready(attempt)
        self._was_home = False
        self._pulse(self._home, attempt, veto=veto)
        self._refuse_alarm(*self._outputs(attempt), attempt)

    def start_move(self, deg: float, /) -> None:
        """Start an absolute move (deg).

        Raises
        ------
        InvalidSetting
            The angle is not a finite number, or beyond the limits; nothing was sent.
        NotHomed
            The axis has no reference position.
        DeviceFault
            There is an alarm, or the driver refuses. Or `stop` came between.
        BadChecksum, TransportTimeout, UnexpectedReply
            It is unknown whether the axis moves: stop it.
        """
        attempt = f"starting to move to {deg:.4f} deg"
        low, high = self._limits
        if not (math.isfinite(deg) and low <= deg <= high):
            raise InvalidSetting(f"angle {deg}", device=self.name, attempt=attempt, expected=f"{low:g} to {high:g} deg")
        veto = self._stops.veto(self._unit, attempt)
        outputs, alarm = self._make_ready(attempt)
        if not self._homed(outputs, alarm):
            raise self._not_homed("HOME-END is off", attempt)
        speed, rate = (round(value * self._scale) for value in (self._profile.speed, self._profile.acceleration))
        fields = (0, _ABSOLUTE, round(deg * self._scale), speed, rate, rate, _FULL_CURRENT, _ALL_FIELDS)
        self._unit.write(_OPERATION, self._unit.words_of_int32(*fields), attempt, veto=veto)
        # The write is acknowledged even when the operation ends in an alarm at once.
        self._refuse_alarm(*self._outputs(attempt), attempt)

    def stop(self) -> None:
        """Tell the driver to decelerate to rest, now. Returns when it has acknowledged, which is before it rests.

        The bytes go out ahead of all that waits for the port. An unacknowledged stop is sent once more.
        """
        with self._stops.lock:
            self._stops.count += 1
        self._pulse(_STOP, "stopping", urgent=True)

    def check_arrival(self, deg: float, tolerance: float, /) -> None:
        """Make sure that the axis rests at an angle (deg) because it got there.

        Raises
        ------
        DeviceFault
            An alarm; or the axis still moves; or it rests further than `tolerance` from the angle.
        """
        attempt = f"arriving at {deg:.4f} deg"
        self._refuse_alarm(*self._outputs(attempt), attempt)
        state = self.state()
        require_arrival(self._unit, state, deg, tolerance, attempt)

    def reset_alarm(self) -> None:
        """Clear the alarm; its cause must be gone.

        Raises
        ------
        DeviceFault
            The alarm stays: some need a power cycle.
        """
        attempt = "clearing the alarm"
        for value in (1, 0):
            self._unit.write(_ALARM_RESET, self._unit.words_of_int32(value), attempt, repeatable=True)
        self._refuse_alarm(*self._outputs(attempt), attempt)

    def close(self) -> None:
        """Let go of the axis without moving it. The link stays open for the others on it."""
        self._unit.closed = True

    def _outputs(self, attempt: str) -> tuple[int, int]:
        """Driver output status and present alarm, which are neighbours."""
        outputs, alarm = self._unit.uint32(self._unit.holding(_OUTPUT, 4, attempt))
        if bool(outputs & _ALARM) != bool(alarm):
            raise self._unit.unexpected(
                f"outputs {outputs:04X}h with alarm {alarm:02X}h", attempt, "ALM-A on if and only if there is an alarm"
            )
        return outputs, alarm

    def _homed(self, outputs: int, alarm: int) -> bool:
        here = bool(outputs & _HOME_END)
        self._was_home = (here or self._was_home) and alarm != _RETURN_INCOMPLETE
        return here or (self._was_home and not self._home_end_holds)

    def _make_ready(self, attempt: str) -> tuple[int, int]:
        """Before a start: no alarm, no input left on by a write that failed, and the driver ready or moving."""
        if self._input_left_on:
            self._clear_input(attempt, urgent=False)
        outputs, alarm = self._outputs(attempt)
        self._refuse_alarm(outputs, alarm, attempt)
        if not outputs & (_READY | _MOVE):
            hint = "is the motor free, or a stop input on? stop the axis: that lowers one which an unacknowledged stop has left on"
            raise self._unit.fault("the driver is not ready", attempt, expected="READY on", hint=hint)
        return outputs, alarm

    def _refuse_alarm(self, outputs: int, alarm: int, attempt: str) -> None:
        if alarm == _RETURN_INCOMPLETE:
            raise self._not_homed(f"alarm {alarm:02X}h, {ALARMS[alarm]}", attempt)
        if alarm:
            meaning = ALARMS.get(alarm, "meaning unknown")
            raise self._unit.fault(
                f"alarm {alarm:02X}h, {meaning}",
                attempt,
                expected="no alarm",
                hint="find the cause, then clear the alarm or cycle the power",
            )

    def _not_homed(self, problem: str, attempt: str) -> DeviceFault:
        return self._unit.fault(
            f"no reference position: {problem}", attempt, kind=NotHomed, expected="HOME-END on", hint="home the axis first"
        )

    def _pulse(self, bit: int, attempt: str, *, urgent: bool = False, veto: Veto | None = None) -> None:
        """Raise an input and lower it again: only the rising edge counts. A stop may be sent twice, a start never."""
        self._input_left_on = True
        self._unit.write_one(_INPUT, bit, attempt, repeatable=urgent, urgent=urgent, veto=veto)
        self._clear_input(attempt, urgent=urgent)

    def _clear_input(self, attempt: str, *, urgent: bool) -> None:
        self._unit.write_one(_INPUT, 0, attempt, repeatable=True, urgent=urgent)
        self._input_left_on = False
