"""Zaber X-series stages, rotary and linear, over Zaber's ASCII protocol.

Source: Zaber ASCII Protocol Manual (firmware 6 and 7). Every request carries a message id and a checksum, every reply must
carry both back, so that a late or damaged reply is never taken for the answer.

Not verified on hardware: the scale of ``accel`` (`ACCELERATION_UNIT`), and that every rotary stage answers ``limit.cycle.dist``.
Both can be given by the user. A linear stage does not tell its scale: its data sheet gives the microstep size.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from drivers.endpoint import Endpoint, Veto
from drivers.errors import BadChecksum, DeviceFault, InvalidSetting, NotHomed, TransportTimeout, UnexpectedReply
from drivers.kinds import AxisState, Identity, MotionProfile, Unit
from drivers.link import Link
from drivers.motion import Stops, require_arrival

VELOCITY_UNIT = 1 / 1.6384
"""Microsteps per second in one unit of ``maxspeed``."""

ACCELERATION_UNIT = 10_000 / 1.6384
"""Microsteps per second squared in one unit of ``accel``. Unverified: hence an option of the axis."""

NO_REFERENCE = frozenset({"WR", "WH"})

_FLAG_NAMES = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive",
    "FH": "hardware emergency stop",
    "FV": "supply voltage out of range",
    "FO": "driver disabled",
    "FD": "driver disabled",
    "FC": "current inrush error",
    "FM": "motor too hot",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analog encoder sync error",
    "FR": "overdrive limit exceeded",
    "FS": "stalled and stopped",
    "FB": "stream bounds error",
    "FP": "path deviation",
    "FE": "limit error",
    "FT": "excessive twist",
    "WL": "unexpected limit trigger",
    "NI": "movement interrupted",
}

_REJECT_HINTS = {
    "BADCOMMAND": "this firmware does not know the command",
    "BADDATA": "the value is beyond what the device allows",
    "BADAXIS": "check the axis number",
    "AGAIN": "the device is busy, ask again later",
    "FULL": "the device is busy, ask again later",
    "STATUSBUSY": "not possible while the axis moves",
    "PARKED": "unpark the axis first",
    "REMOTE": "the device is under remote control",
    "DRIVERDISABLED": "the motor driver is off: look for an overheated or overloaded stage, then enable the driver",
    "INACTIVE": "no peripheral is connected to this axis",
}

_BODY = re.compile(r"(?P<device>\d\d) (?P<axis>\d)(?: (?P<id>\d\d))?(?: (?P<rest>.*))?", re.ASCII)
_REPLY = re.compile(r"(?P<verdict>OK|RJ) (?P<status>BUSY|IDLE) (?P<flag>--|[A-Z]{2}) (?P<data>\S.*)", re.ASCII)
_ALERT = re.compile(r"(?P<status>BUSY|IDLE) (?P<flag>--|[A-Z]{2})(?: (?P<data>\S.*))?", re.ASCII)
_IDS = 100
_KINDS: dict[str, Literal["reply", "info", "alert"]] = {"@": "reply", "#": "info", "!": "alert"}
_RESERVED = frozenset("/@!#:\\\r\n")


def checksum(text: bytes) -> str:
    """Longitudinal redundancy check of what stands between the leading ``/ @ # !`` and the ``:``, as two hex digits."""
    return f"{-sum(text) & 0xFF:02X}"


def encode_command(device: int, axis: int, message_id: int, words: str = "", *, with_checksum: bool = True) -> bytes:
    r"""Make a command line, for instance ``b"/1 1 34 move abs 1000:E9\n"``.

    Parameters
    ----------
    device : int
        Address, 0 (all) to 99.
    axis : int
        0 (the device as a whole) to 9.
    message_id : int
        0 to 99; comes back in the reply.
    words : str
        The command; empty asks for the status.

    Raises
    ------
    InvalidSetting
        A number is out of range, or the words hold a character that the protocol reserves.
    """
    if not (0 <= device <= 99 and 0 <= axis <= 9 and 0 <= message_id <= 99):
        raise InvalidSetting(f"device {device}, axis {axis}, message id {message_id}", expected="device 0..99, axis 0..9, id 0..99")
    if _RESERVED & set(words) or not words.isascii() or not (words.isprintable() or not words):
        raise InvalidSetting(f"command {words!r}", expected=r"printable ASCII without / @ ! # : \ and line ends")
    text = f"{device} {axis} {message_id:02d} {words}".rstrip().encode("ascii")
    return b"/" + text + (b":" + checksum(text).encode("ascii") if with_checksum else b"") + b"\n"


@dataclass(frozen=True)
class Message:
    """One line from a device.

    Attributes
    ----------
    kind : str
        ``reply`` (``@``), ``info`` (``#``) or ``alert`` (``!``).
    message_id : int, optional
        None when the line carries none.
    rejected, busy : bool
        Meaningless for info lines, and then False.
    flag : str
        Warning flag of the highest priority, ``--`` for none.
    data : str
        The rest of the line.
    """

    kind: Literal["reply", "info", "alert"]
    device: int
    axis: int
    message_id: int | None
    rejected: bool
    busy: bool
    flag: str
    data: str


def parse_message(line: bytes, *, checksum_required: bool = True) -> Message:
    """Take a line apart (given without its CR LF).

    Raises
    ------
    BadChecksum
        The checksum is wrong, or missing although required.
    UnexpectedReply
        The line does not follow the grammar.
    """
    expected = "a line like '@01 1 17 OK IDLE -- 0:xx'"
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError as error:
        raise UnexpectedReply("bytes that are not ASCII", raw=line, expected=expected) from error
    body, colon, sent_checksum = text[1:].partition(":")
    if colon:
        right = checksum(body.encode("ascii"))
        if sent_checksum != right:
            raise BadChecksum(f"checksum {sent_checksum!r}", raw=line, expected=f"checksum {right}")
    elif checksum_required:
        raise BadChecksum("no checksum", raw=line, expected="a checksum, as in the command")
    kind = _KINDS.get(text[:1])
    head = _BODY.fullmatch(body)
    if kind is None or head is None:
        raise UnexpectedReply("a malformed line", raw=line, expected=expected)
    if body.endswith("\\"):
        raise UnexpectedReply("a reply in several packets", raw=line, expected="a reply in one packet")
    rest = head["rest"] or ""
    grammar = {"reply": _REPLY, "alert": _ALERT}.get(kind)
    fields: dict[str, str | None] = {"data": rest}
    if grammar is not None:
        match = grammar.fullmatch(rest)
        if match is None:
            raise UnexpectedReply(f"a malformed {kind}", raw=line, expected=expected)
        fields = match.groupdict()
    return Message(
        kind=kind,
        device=int(head["device"]),
        axis=int(head["axis"]),
        message_id=None if head["id"] is None else int(head["id"]),
        rejected=fields.get("verdict") == "RJ",
        busy=fields.get("status") == "BUSY",
        flag=fields.get("flag") or "--",
        data=fields["data"] or "",
    )


class ZaberAxis:
    """One axis of one Zaber device; satisfies `drivers.kinds.Stage`. Several may share a link.

    Parameters
    ----------
    link : Link
        Stays the caller's to close.
    name : str
        For messages.
    microsteps_per_unit : float
        Scale; `ZaberAxis.open` reads it from a rotary stage.
    unit : str
        ``deg``, or ``mm`` for a linear stage.
    address : int
        Device address on the chain.
    axis : int
        Axis of that device.
    acceleration_unit : float, microsteps/s^2
        What one unit of ``accel`` means; the default is unverified.
    checksums : bool
        Send checksums and insist on them in replies.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        *,
        microsteps_per_unit: float,
        unit: Unit = "deg",
        address: int = 1,
        axis: int = 1,
        acceleration_unit: float = ACCELERATION_UNIT,
        checksums: bool = True,
    ) -> None:
        if not (math.isfinite(microsteps_per_unit) and microsteps_per_unit > 0):
            raise InvalidSetting(f"{microsteps_per_unit} microsteps per {unit}", device=name, expected="a finite number above 0")
        if not (math.isfinite(acceleration_unit) and acceleration_unit > 0):
            raise InvalidSetting(f"acceleration_unit {acceleration_unit}", device=name, expected="a finite number above 0")
        if not (1 <= address <= 99 and 1 <= axis <= 9):
            raise InvalidSetting(f"address {address}, axis {axis}", device=name, expected="address 1..99, axis 1..9")
        self._scale = microsteps_per_unit
        self._unit: Unit = unit
        self._acceleration_unit = acceleration_unit
        self._wire = _Wire(link, name, address, axis, checksums)
        self._stops = Stops()

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        microsteps_per_unit: float | None = None,
        unit: Unit = "deg",
        speed: float | None = None,
        acceleration: float | None = None,
        **options: Any,
    ) -> ZaberAxis:
        """Meet the stage: read its scale unless given, and set speed and acceleration if given. Nothing moves.

        Parameters
        ----------
        options
            The constructor's.

        Raises
        ------
        InvalidSetting
            The stage is linear and its scale is not given.
        DeviceFault
            The stage does not know its microsteps per revolution (``limit.cycle.dist``), or refuses a setting.
        """
        if microsteps_per_unit is None and unit == "mm":
            hint = "give microsteps_per_mm: 1000 over the microstep size in um, from the stage's data sheet"
            raise InvalidSetting("no scale", device=name, port=link.url, attempt="opening a linear stage", hint=hint)
        stage = cls(link, name, microsteps_per_unit=1.0 if microsteps_per_unit is None else microsteps_per_unit, unit=unit, **options)
        if microsteps_per_unit is None:
            attempt = "reading the microsteps per revolution"
            try:
                per_revolution = stage._wire.number("limit.cycle.dist", attempt)
            except DeviceFault as fault:
                fault.hint = f"{fault.hint}; or give microsteps_per_degree in the configuration"
                raise
            if per_revolution <= 0:
                raise stage._wire.fault(
                    f"limit.cycle.dist is {per_revolution:g}",
                    attempt,
                    expected="microsteps per revolution",
                    hint="give microsteps_per_degree in the configuration",
                )
            stage._scale = per_revolution / 360
        stage.set_profile(speed, acceleration)
        return stage

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._wire.name

    @property
    def unit(self) -> Unit:
        """What it counts in."""
        return self._unit

    @property
    def microsteps_per_unit(self) -> float:
        """Scale in use."""
        return self._scale

    def identify(self) -> Identity:
        """Ask for device id, serial number and firmware version. The numbers' meaning is in Zaber's device database."""
        read = self._wire.read
        return Identity(
            vendor="Zaber",
            model=f"device id {read('get deviceid', 'reading the device id', axis=0).data}",
            serial_number=read("get system.serial", "reading the serial number", axis=0).data,
            firmware=read("get version", "reading the firmware version", axis=0).data,
        )

    def state(self) -> AxisState:
        """Ask for position and status in one exchange, and for all warning flags in a second if there is any."""
        reply = self._wire.read("get pos", "reading the position")
        flags = () if reply.flag == "--" else self._flags("warnings")
        return AxisState(
            position=self._wire.to_number(reply, "reading the position") / self._scale,
            moving=reply.busy,
            homed=NO_REFERENCE.isdisjoint(flags),
            warnings=flags,
        )

    def limits(self) -> tuple[float, float]:
        """Read the stage's own lower and upper limit."""
        low = self._wire.number("limit.min", "reading the lower limit")
        high = self._wire.number("limit.max", "reading the upper limit")
        return low / self._scale, high / self._scale

    def profile(self) -> MotionProfile:
        """Read ``maxspeed`` and ``accel`` from the stage.

        Raises
        ------
        DeviceFault
            Either reads 0, so that no arrival can be predicted.
        """
        speed = self._wire.number("maxspeed", "reading the speed")
        acceleration = self._wire.number("accel", "reading the acceleration")
        if speed <= 0 or acceleration <= 0:
            raise self._wire.fault(
                f"maxspeed {speed:g}, accel {acceleration:g}",
                "reading the motion profile",
                expected="both above 0",
                hint="set speed and acceleration",
            )
        return MotionProfile(speed * VELOCITY_UNIT / self._scale, acceleration * self._acceleration_unit / self._scale)

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None:
        """Set speed (unit/s), acceleration (unit/s^2) or both, to the nearest value the stage can express.

        Raises
        ------
        InvalidSetting
            A value is not finite, or too small to express.
        DeviceFault
            The stage refuses it.
        """
        settings = (
            ("maxspeed", speed, VELOCITY_UNIT, f"speed in {self._unit}/s"),
            ("accel", acceleration, self._acceleration_unit, f"acceleration in {self._unit}/s^2"),
        )
        commands = []
        for setting, value, unit, what in settings:
            if value is None:
                continue
            smallest = unit / self._scale
            if not (math.isfinite(value) and value >= smallest):
                expected = f"a finite number, {smallest:.3g} or more"
                raise InvalidSetting(f"{what} {value}", device=self.name, attempt=f"setting {setting}", expected=expected)
            commands.append((f"set {setting} {round(value / smallest)}", f"setting the {what}"))
        for words, attempt in commands:  # only now that all are known to make sense
            self._wire.act(words, attempt)

    def start_home(self) -> None:
        """Start homing. When it is over, `state` says ``homed``."""
        attempt = "starting to home"
        reply = self._start("home", attempt)
        if reply.rejected:
            raise self._wire.rejection(reply, attempt)

    def start_move(self, position: float, /) -> None:
        """Start an absolute move.

        Raises
        ------
        InvalidSetting
            The position is not a finite number.
        NotHomed
            The stage has no reference position.
        DeviceFault
            The stage refuses; with BADDATA, the position is beyond its limits. Or `stop` came between.
        BadChecksum, TransportTimeout, UnexpectedReply
            It is unknown whether the stage moves: stop it.
        """
        if not math.isfinite(position):
            raise InvalidSetting(
                f"position {position}", device=self.name, attempt="starting to move", expected=f"a finite number in {self._unit}"
            )
        attempt = f"starting to move to {position:.4f} {self._unit}"
        reply = self._start(f"move abs {round(position * self._scale)}", attempt)
        if not reply.rejected:
            return
        # The reply names one flag only; a worse one may hide the missing reference.
        if reply.data == "BADDATA" and not NO_REFERENCE.isdisjoint(flags := self._flags("warnings")):
            raise self._wire.fault(
                "no reference position",
                attempt,
                kind=NotHomed,
                expected=f"no warning WR or WH, but there is {' '.join(flags)}",
                hint="home the axis first",
            )
        raise self._wire.rejection(reply, attempt)

    def stop(self) -> None:
        """Tell the stage to decelerate to rest, now. Returns when it has acknowledged, which is before it rests.

        The bytes go out at once, even while other threads wait on the link. An unacknowledged stop is sent once more.
        """
        with self._stops.lock:
            self._stops.count += 1
        self._wire.act("stop", "stopping", urgent=True)

    def check_arrival(self, position: float, tolerance: float, /) -> None:
        """Make sure that the stage rests at a position because it got there.

        Raises
        ------
        DeviceFault
            A fault flag (``F?``), an unexpected limit switch (``WL``) or an interruption (``NI``) since the last start of a
            motion; or the stage still moves; or it rests further than `tolerance` from it.
        """
        state = self.state()
        attempt = f"arriving at {position:.4f} {self._unit}"
        bad = [flag for flag in state.warnings if flag.startswith("F") or flag in ("WL", "NI")]
        if bad:
            meanings = ", ".join(f"{flag} ({_FLAG_NAMES.get(flag, 'fault')})" for flag in bad)
            raise self._wire.fault(
                f"{meanings} at {state.position:.4f} {self._unit}",
                attempt,
                expected="an undisturbed motion",
                hint="find the cause, then move or home again",
            )
        require_arrival(self._wire, state, position, tolerance, attempt, unit=self._unit)

    def close(self) -> None:
        """Let go of the stage without moving it. The link stays open for the others on it."""
        self._wire.closed = True

    def _flags(self, words: str) -> tuple[str, ...]:
        """All warning flags: the reply to ``warnings`` is their count and then the flags."""
        attempt = "reading the warning flags"
        reply = self._wire.read(words, attempt)
        count, *flags = reply.data.split()
        if not count.isdecimal() or int(count) != len(flags):
            raise self._wire.nonsense(reply, attempt, "a count and as many flags")
        return tuple(flags)

    def _start(self, words: str, attempt: str) -> Message:
        """Send a motion command, unless `stop` is called before its bytes are out: a stop must not be followed by an older motion."""
        veto = self._stops.veto(self._wire, attempt)
        self._flags("warnings clear")  # they tell of earlier motions; check_arrival is to speak of this one
        return self._wire.ask(words, attempt, veto=veto)


class _Wire(Endpoint):
    """Questions and answers with one axis."""

    def __init__(self, link: Link, name: str, address: int, axis: int, checksums: bool) -> None:
        super().__init__(link, name)
        link.unasked = (b"!", b"#")  # alerts and information
        self._address = address
        self._axis = axis
        self._checksums = checksums
        self._id_lock = threading.Lock()
        self._last_id = -1
        self._ids_in_flight: set[int] = set()

    def ask(
        self,
        words: str,
        attempt: str,
        *,
        axis: int | None = None,
        repeatable: bool = False,
        urgent: bool = False,
        veto: Veto | None = None,
    ) -> Message:
        """Send a command and return its reply, rejected or not."""
        self.require_open(attempt)  # a closed one uses up no message id
        axis = self._axis if axis is None else axis
        with self._fresh_id() as message_id:
            return self._ask_as(message_id, words, attempt, axis, repeatable=repeatable, urgent=urgent, veto=veto)

    def _ask_as(
        self,
        message_id: int,
        words: str,
        attempt: str,
        axis: int,
        *,
        repeatable: bool,
        urgent: bool,
        veto: Veto | None,
    ) -> Message:
        head = b"@%02d %d %02d " % (self._address, axis, message_id)
        damaged: list[BadChecksum | UnexpectedReply] = []

        def accept(line: bytes) -> Message | None:
            # @ is reserved, so a reply starts at the last one; noise before it is harmless if the checksum then holds.
            start = line.rfind(b"@") if self._checksums else 0
            line = line[max(start, 0) :]
            try:
                message = parse_message(line, checksum_required=self._checksums)
            except (BadChecksum, UnexpectedReply) as error:
                if line.startswith(head):
                    raise
                if line[:1] not in (b"!", b"#"):
                    damaged.append(error)  # perhaps ours, with its address or id damaged
                return None
            ours = message.kind == "reply" and (message.device, message.axis, message.message_id) == (self._address, axis, message_id)
            return message if ours else None

        request = encode_command(self._address, axis, message_id, words, with_checksum=self._checksums)
        expected = f"a reply starting {head.decode('ascii')!r}"
        try:
            return self.exchange(request, accept, attempt, expected, repeatable=repeatable, urgent=urgent, veto=veto)
        except TransportTimeout as timeout:
            if not damaged:
                raise
            damage = damaged[-1]
            damage.complete(
                device=timeout.device, port=timeout.port, attempt=attempt, sent=request, expected=expected, elapsed_s=timeout.elapsed_s
            )
            raise damage from timeout

    def act(self, words: str, attempt: str, *, urgent: bool = False) -> None:
        """Send a command that changes something. Only an urgent one, a stop, may be repeated."""
        reply = self.ask(words, attempt, repeatable=urgent, urgent=urgent)
        if reply.rejected:
            raise self.rejection(reply, attempt)

    def read(self, words: str, attempt: str, *, axis: int | None = None) -> Message:
        """Ask something that may safely be asked twice."""
        reply = self.ask(words, attempt, axis=axis, repeatable=True)
        if reply.rejected:
            raise self.rejection(reply, attempt)
        return reply

    def number(self, setting: str, attempt: str) -> float:
        """Read a setting of the axis."""
        return self.to_number(self.read(f"get {setting}", attempt), attempt)

    def to_number(self, reply: Message, attempt: str) -> float:
        """The data of a reply as one finite number."""
        try:
            number = float(reply.data)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self.nonsense(reply, attempt, "one number")
        return number

    def rejection(self, reply: Message, attempt: str) -> DeviceFault:
        """Make the error for an RJ reply."""
        flag = "" if reply.flag == "--" else f", flag {reply.flag}"
        return self.fault(f"rejected with {reply.data}{flag}", attempt, expected="OK", hint=_REJECT_HINTS.get(reply.data, ""))

    def nonsense(self, reply: Message, attempt: str, expected: str) -> UnexpectedReply:
        """Make the error for data that make no sense."""
        return self.unexpected(f"data {reply.data!r}", attempt, expected, raw=reply.data.encode("ascii"))

    @contextmanager
    def _fresh_id(self) -> Iterator[int]:
        """Lend a message id that no unanswered request of this axis bears; a hundred stops may overtake one slow question."""
        with self._id_lock:
            following = ((self._last_id + step) % _IDS for step in range(1, _IDS + 1))
            message_id = next(candidate for candidate in following if candidate not in self._ids_in_flight)
            self._last_id = message_id
            self._ids_in_flight.add(message_id)
        try:
            yield message_id
        finally:
            with self._id_lock:
                self._ids_in_flight.remove(message_id)
