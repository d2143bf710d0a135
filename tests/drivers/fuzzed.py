"""Every decoder of the drivers, frames it must take, what may befall them on the line, and what frames really say.

What a decoder accepts is read again here, by other means than the driver's. Frames are the sheet's, or made from its fields; their
checksums are reckoned here.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from functools import cache, partial
from typing import Any

import numpy as np

from drivers.errors import BadChecksum, DeviceFault, TransportTimeout, UnexpectedReply
from drivers.kinds import AxisState, DistanceReading, Identity, LightReading
from drivers.link import Link
from drivers.modbus import ModbusLink, ModbusRefusal, ModbusUnit, text
from drivers.rangefinders import optoncdt1420
from drivers.rangefinders.baumer_om import BaumerOM
from drivers.sensors import keithley6485, konica_minolta
from drivers.sensors.apogee import SQ422X
from drivers.stages import newport, sigma_koki
from drivers.stages.oriental import OrientalAxis
from drivers.stages.zaber import Message, ZaberAxis, parse_message
from tests.drivers.rtu import Canned

NAMED = (BadChecksum, UnexpectedReply, TransportTimeout, DeviceFault)
"""What a decoder may raise about a frame. A setting that cannot be (InvalidSetting) is a caller's mistake, never a frame's."""

Edit = tuple[int, int, int]
"""Kind, place and value; any numbers."""

EDITS = 12


@dataclass(frozen=True)
class Decoder:
    """One way from bytes to a value.

    Attributes
    ----------
    decode : callable
        Bytes to a value, None for a line that belongs to somebody else, or a `DeviceError`.
    frames : tuple of bytes
        Valid ones, without their checksums.
    says : callable
        Whether the bytes say the value accepted.
    seal : callable
        Appends the checksum where there is one.
    """

    name: str
    decode: Callable[[bytes], Any]
    frames: tuple[bytes, ...]
    says: Callable[[bytes, Any], bool]
    seal: Callable[[bytes], bytes] = bytes


def outcome(decoder: Decoder, data: bytes) -> str:
    """Decode, and name what came of it; anything but a true value or a named error is an AssertionError."""
    value: Any = None
    try:
        value = decoder.decode(data)
        true = value is None or decoder.says(data, value)
    except NAMED as error:
        return type(error).__name__
    except Exception as error:
        raise AssertionError(f"{decoder.name}: {data!r} gave {value!r} and {error!r}") from error
    assert true, f"{decoder.name}: {data!r} was taken for {value!r}"
    return "passed over" if value is None else "accepted"


def tally(decoder: Decoder, cases: Iterable[bytes]) -> Counter[str]:
    """Count the outcomes."""
    return Counter(outcome(decoder, data) for data in cases)


def mutated(decoder: Decoder, count: int, rng: np.random.Generator) -> Iterator[bytes]:
    """Frames with one to three edits: half of them damaged on the line, half sealed afterwards as if the device had meant them."""
    sealed = [decoder.seal(frame) for frame in decoder.frames]
    noise = rng.bytes(4096)
    for first, second, before, *numbers in rng.integers(0, 1 << 31, (count, 12)).tolist():
        frame = decoder.frames[first % len(sealed)]
        other = sealed[second % len(sealed)]
        edits = [(numbers[at], numbers[at + 1], numbers[at + 2]) for at in range(0, 3 * (1 + numbers[0] % 3), 3)]
        if before % 2:
            yield decoder.seal(edited(frame, edits, other, noise))
        else:
            yield edited(decoder.seal(frame), edits, other, noise)


def edited(frame: bytes, edits: Iterable[Edit], other: bytes, noise: bytes) -> bytes:
    """Do to a frame what a line does: flip, drop, double, insert bytes, cut it short, splice it with another, bury it in noise or runs."""
    for kind, place, value in edits:
        at = place % (len(frame) + 1)
        head, byte, tail = frame[:at], frame[at : at + 1], frame[at + 1 :]
        match kind % EDITS:
            case 0:
                frame = head + bytes(each ^ 1 << value % 8 for each in byte) + tail
            case 1:
                frame = head + bytes([value % 256]) + tail
            case 2:  # a byte that the protocol knows, at the wrong place
                frame = head + frame[value % max(len(frame), 1) :][:1] + tail
            case 3:
                frame = head + b"0123456789"[value % 10 :][:1] + tail
            case 4:
                frame = head + tail
            case 5:
                frame = head + byte * 2 + tail
            case 6:
                frame = head + bytes([value % 256]) + byte + tail
            case 7:
                frame = head
            case 8:
                frame = frame[at:]
            case 9:
                frame = head + other[value % (len(other) + 1) :]
            case 10:
                frame = noise[place % len(noise) :][: value % 64] if value % 2 else head + noise[place % len(noise) :][: value % 64] + tail
            case 11:  # long, but seldom very long
                frame = head + byte * (value % (2000 if value % 31 == 0 else 40)) + tail
    return frame


# Zaber ----------------------------------------------------------------------------------------------------------------


def with_lrc(line: bytes) -> bytes:
    """Append Zaber's checksum: all after the first character and the checksum add up to 0. Source: sheet 1.3."""
    return line + b":%02X" % ((256 - sum(line[1:]) % 256) % 256)


ZABER = (
    b"@01 0 00 OK IDLE WR 0",  # sheet 1.3
    b"@01 1 17 OK IDLE -- 0",  # sheet 1.2
    b"@01 1 17 OK BUSY -- 384000",
    b"@01 1 17 OK IDLE WR 02 WR NI",
    b"@01 1 17 RJ IDLE WR BADDATA",
    b"@02 1 OK IDLE FS -15000",
    b"!01 1 IDLE --",
    b"!01 1 BUSY FS stalled",
    b"#01 0 17 cont get",
)


def _zaber_says(line: bytes, message: Message) -> bool:
    sign = {"reply": "@", "alert": "!", "info": "#"}[message.kind]
    words = [f"{sign}{message.device:02d}", str(message.axis)]
    if message.message_id is not None:
        words.append(f"{message.message_id:02d}")
    if message.kind == "reply":
        words.append("RJ" if message.rejected else "OK")
    if message.kind != "info":
        words += ["BUSY" if message.busy else "IDLE", message.flag]
    words.append(message.data)
    return with_lrc(" ".join(words).encode()) == line or (not message.data and with_lrc(" ".join(words[:-1]).encode()) == line)


class _ZaberLine:
    """A stage whose reply to message 17 is given, and its own for all others."""

    def __init__(self) -> None:
        self._reply = b""
        link = Link(Canned(self._answer), url="canned://", timeout_s=1e-9)  # type: ignore[arg-type]
        self._axis = ZaberAxis(link, "stage", microsteps_per_unit=1000.0)

    def _answer(self, request: bytes) -> bytes:
        if b" 17 " in request:
            return self._reply
        return with_lrc(b"@01 1 %b OK IDLE WR 01 WR" % request.split()[2]) + b"\r\n"

    def __call__(self, reply: bytes) -> AxisState:
        """Read the state."""
        self._reply = reply
        self._axis._wire._last_id = 16
        return self._axis.state()


def _zaber_state_says(data: bytes, state: AxisState) -> bool:
    for line in data.split(b"\r\n"):
        line = line[max(line.rfind(b"@"), 0) :]
        words = line.rpartition(b":")[0].split(b" ")
        if with_lrc(line.rpartition(b":")[0]) != line or words[:3] != [b"@01", b"1", b"17"] or len(words) < 7 or words[3] != b"OK":
            continue
        if (words[4] == b"BUSY") == state.moving:
            return math.isclose(float(b" ".join(words[6:])) / 1000, state.position, abs_tol=1e-12)
    return False


# Newport --------------------------------------------------------------------------------------------------------------


def _esp_error_says(line: bytes, error: newport.EspError) -> bool:
    code, stamp, message = (part.strip() for part in line.split(b",", 2))
    return stamp.isdigit() and len(code) <= 3 and int(code) == error.code and message.decode("ascii") == error.text != ""


def _esp_version_says(line: bytes, version: tuple[str, str]) -> bool:
    return line.decode("ascii").split(None, 1)[0] == version[0] and line.decode("ascii").split(None, 1)[1].strip() == version[1]


# Sigma Koki -----------------------------------------------------------------------------------------------------------


def _shot_says(line: bytes, status: sigma_koki.Status) -> bool:
    """Read the fixed columns. Source: sheet 3."""
    columns = (line[0:10], line[11:21])
    commas = {line[at : at + 1] for at in (10, 21, 23, 25)}
    letters = (line[22:23] == b"X", line[24:25], line[26:] == b"B")
    stopped = {b"K": (), b"L": (1,), b"M": (2,), b"W": (1, 2)}[letters[1]]
    pulses = tuple(int(b"".join(column.split())) for column in columns)
    return (
        commas == {b","}
        and len(line) == 27
        and (pulses, *letters[::2], stopped) == (status.pulses, status.failed, status.busy, status.limits)
    )


# sensors --------------------------------------------------------------------------------------------------------------


def _keithley_says(line: bytes, reading: LightReading) -> bool:
    value, seconds, status = line.decode("ascii").strip().split(",")
    bits = int(float(status))
    over = abs(float(value[:-1])) > 9.8e37 or bits % 2 == 1
    told = math.copysign(math.inf, float(value[:-1])) if over else float(value[:-1])
    return (value[-1], told, over, bits, float(seconds)) == ("A", reading.value, reading.over_range, reading.status, reading.device_time_s)


def _identity_says(line: bytes, who: Identity) -> bool:
    return [part.strip() for part in line.decode("ascii").split(",", 3)] == [
        who.vendor,
        f"MODEL {who.model}",
        who.serial_number,
        who.firmware,
    ]


def _scpi_error_says(line: bytes, error: tuple[int, str]) -> bool:
    code, _, message = line.decode("latin-1").strip().partition(",")
    return int(code) == error[0] and message.lstrip(" \t\r\n\v\f").strip('"') == error[1]


def _minolta_says(line: bytes, reading: LightReading, numbers: int) -> bool:
    code, *fields = (part.strip() for part in line.decode("ascii").strip().split(","))
    if code in ("OK11", "OK12", "ER10", "ER19"):
        return reading.over_range and not reading.good
    if code == "OK13":
        return reading.under_range and not reading.good
    chromaticity = all(0 <= float(field) <= 1 for field in fields[1:])
    return code == "OK00" and len(fields) == numbers and float(fields[0]) == reading.value and chromaticity and reading.good


# optoNCDT -------------------------------------------------------------------------------------------------------------


INFO = b"""GETINFO\r
Name:            ILD1420-50\r
Serial:       1234567\r
Option:       000\r
Measuring range:  50.00mm\r
Version:  003.005\r
"""


def triple(word: int, first: bool = True) -> bytes:
    """Three bytes of a value. Source: sheet 6.2."""
    bits = f"{word:018b}"
    return bytes(int(tag + part, 2) for tag, part in (("00", bits[12:]), ("01", bits[6:12]), ("10" if first else "11", bits[:6])))


def _stream(data: bytes) -> list[tuple[bytes, optoncdt1420.Value]]:
    found = optoncdt1420.ValueSplitter().feed(data)
    return [(frame, optoncdt1420.parse_value(frame)) for frame in found if optoncdt1420._is_value(frame)]


def _stream_says(data: bytes, values: list[tuple[bytes, optoncdt1420.Value]]) -> bool:
    at = 0
    for frame, value in values:
        at = data.find(frame, at) + 3  # in this order, none of them twice
        if at < 3 or triple(value.word, value.first) != frame:
            return False
    return True


def _texts(data: bytes) -> list[str]:
    found = optoncdt1420.ValueSplitter().feed(data + b"->")
    return [frame.decode("ascii") for frame in found if not optoncdt1420._is_value(frame)]  # what belongs to values is gone


def _infos(data: bytes) -> list[dict[str, str]] | None:
    return [optoncdt1420.parse_info(text) for text in _texts(data)] or None


def _infos_say(data: bytes, infos: list[dict[str, str]]) -> bool:
    plain = re.sub(rb"[\x80-\xff]", b"", re.sub(rb"(?s)[\x00-?][@-\x7f][\x80-\xff]", b"", data)).decode("ascii")
    told: dict[str, set[str]] = {}
    for line in plain.replace("->", "\n").splitlines():
        key, _, value = line.partition(":")
        told.setdefault(key.strip().lower(), set()).add(value.strip())
    return all(value in told.get(key, ()) for info in infos for key, value in info.items())


def _echo_says(data: bytes, taken: bool) -> bool:
    lines = re.split(rb"[\r\n\v\f\x1c-\x1e]", data)
    found = (re.fullmatch(rb"[\s\x1f]*MEASRATE [\s+]*([\d.]+(?:[Ee][+-]?\d+)?)[\s\x1f]*", line) for line in lines)
    return taken and any(match and abs(Decimal(match[1].decode()) - 1) < Decimal("1e-8") for match in found)


# Modbus ---------------------------------------------------------------------------------------------------------------


@cache
def _remainders() -> list[int]:
    """What eight shifts through the generator leave of each byte."""
    table = list(range(256))
    for _ in range(8):
        table = [entry >> 1 ^ (0xA001 if entry & 1 else 0) for entry in table]
    return table


def with_crc(frame: bytes) -> bytes:
    """Append the checksum of a Modbus frame, low byte first. Source: Serial Line V1.02, 6.2.2."""
    table, remainder = _remainders(), 0xFFFF
    for byte in frame:
        remainder = remainder >> 8 ^ table[(remainder ^ byte) & 0xFF]
    return frame + remainder.to_bytes(2, "little")


def replies(data: bytes, function: int, length: int) -> list[bytes]:
    """The data, `length` bytes each, of all replies of device 1 to a read that are to be found anywhere in what came."""
    head = bytes((1, function, length))
    places = (found.start() for found in re.finditer(b"(?=" + re.escape(head) + b")", data))
    frames = (data[place : place + length + 5] for place in places)
    return [frame[3:-2] for frame in frames if len(frame) == length + 5 and with_crc(frame[:-2]) == frame]


class _Instant(ModbusLink):
    """A Modbus link on which nothing is ever late."""

    def _drop_what_is_late(self, urgent: bool) -> tuple[bool, str]:
        return False, ""


class _Registers:
    """A device on the bus that gives the answer under test to every request, but for those given.

    Parameters
    ----------
    ask : callable
        Makes a question to the device at the other end of a link.
    first : str
        Answer to the first request of a question.
    others : dict
        Answers by the first register asked for.
    """

    def __init__(
        self, ask: Callable[[ModbusLink], Callable[[], Any]], *, first: str | None = None, others: dict[int, str] | None = None
    ) -> None:
        self._first = None if first is None else with_crc(bytes.fromhex(first))
        self._others = {at: with_crc(bytes.fromhex(body)) for at, body in (others or {}).items()}
        self._reply, self._asked, self._function = b"", 0, 0
        self._ask = ask(_Instant(Canned(self._answer), url="canned://", timeout_s=1e-9))

    def _answer(self, request: bytes) -> bytes:
        self._function = request[1]
        self._asked += 1
        if self._first is not None and self._asked == 1:
            return self._first
        return self._others.get(int.from_bytes(request[2:4], "big"), self._reply)

    def __call__(self, reply: bytes) -> Any:
        """Ask."""
        self._reply, self._asked = reply, 0
        try:
            return self._ask()
        except ModbusRefusal as refusal:
            if with_crc(bytes((1, self._function | 0x80, refusal.code))) not in reply:
                raise AssertionError(f"{reply!r} is no refusal") from refusal
            raise


def _hex(*bodies: str) -> tuple[bytes, ...]:
    return tuple(bytes.fromhex(body) for body in bodies)


def _input(link: ModbusLink) -> Callable[[], Any]:
    return partial(ModbusUnit(link, "probe").input, 202, 2, "reading")


def _discrete(link: ModbusLink) -> Callable[[], Any]:
    return partial(ModbusUnit(link, "probe").discrete, 5, 10, "reading")


def _text(link: ModbusLink) -> Callable[[], Any]:
    unit = ModbusUnit(link, "probe")
    return lambda: text(unit.input(110, 5, "reading"))


def _write(link: ModbusLink) -> Callable[[], Any]:
    unit = ModbusUnit(link, "probe")

    def write() -> bool:
        unit.write_one(0x7D, 0x20, "stopping", repeatable=True)
        return True

    return write


def _write_many(link: ModbusLink) -> Callable[[], Any]:
    unit = ModbusUnit(link, "probe")

    def write() -> bool:
        unit.write(0x58, (0,) * 16, "starting")
        return True

    return write


def _az(link: ModbusLink) -> Callable[[], Any]:
    return OrientalAxis(link, "stage", steps_per_degree=50.0).state


def _az_outputs_say(data: bytes, state: AxisState) -> bool:
    for words in replies(data, 3, 8):
        outputs, alarm = struct.unpack(">II", words)
        warnings = (f"ALARM {alarm:02X}",) if outputs >> 7 & 1 else ("INFO",) if outputs >> 6 & 1 else ()
        consistent = bool(alarm) == bool(outputs >> 7 & 1)
        if consistent and (bool(outputs >> 13 & 1), warnings, state.position) == (state.moving, state.warnings, 170.0):
            return True
    return False


def _az_position_says(data: bytes, state: AxisState) -> bool:
    return any(math.isclose(struct.unpack(">i", words)[0] * 0.02, state.position, abs_tol=1e-12) for words in replies(data, 3, 4))


def _apogee(link: ModbusLink) -> Callable[[], Any]:
    return SQ422X(link, "lamp", full_scale=4000.0).read


def _apogee_says(data: bytes, reading: LightReading) -> bool:
    for words in replies(data, 3, 4):
        (flux,) = struct.unpack(">f", words)
        if (flux >= 4000, math.inf if flux >= 4000 else flux) == (reading.over_range, reading.value):
            return True
    return False


def _baumer(link: ModbusLink) -> Callable[[], Any]:
    return BaumerOM(link, "range", fresh_s=1e-6).read


def _baumer_says(data: bytes, reading: DistanceReading) -> bool:
    for words in replies(data, 4, 26):
        quality, outputs = struct.unpack(">HH", words[:4])
        (distance,) = struct.unpack(">f", words[6:8] + words[4:6])  # low word first: sheet 6.1
        vouched = quality == 0 and not outputs & 2 and not math.isnan(distance)
        told = math.inf if math.isnan(distance) else distance
        if (quality, told, vouched) == (reading.status, reading.distance_mm, reading.good):
            return True
    return False


BLOCK = "01 04 1A 0000 0001 7C37 428B 0000 43FA 000A 07D0 0000 0005 0000 {:04X} 0000"
"""Measurements from 200 on, with the distance of sheet 6.1: 69.7426 mm."""


def decoders() -> tuple[Decoder, ...]:
    """All of them, with frames from the sheet."""
    return (
        Decoder("Zaber message", parse_message, ZABER, _zaber_says, with_lrc),
        Decoder(
            "Zaber state over the link",
            _ZaberLine(),
            ZABER[1:5],
            _zaber_state_says,
            lambda line: with_lrc(line) + b"\r\n",
        ),
        Decoder(
            "ESP error",
            newport.parse_error,
            (b"0, 451322, NO ERROR DETECTED", b"103, 451322, FOLLOWING ERROR THRESHOLD EXCEEDED", b"6, 12, COMMAND DOES NOT EXIST"),
            _esp_error_says,
        ),
        Decoder("ESP number", newport.parse_number, (b"45.0002", b"-0.0002", b"+1.5E-3", b"1"), lambda line, number: float(line) == number),
        Decoder("ESP version", newport.find_version, (b"ESP301 Version 3.10 01/02/03", b"ESP300 Version 1.5"), _esp_version_says),
        Decoder(
            "SHOT and GSC status",
            sigma_koki.parse_status,
            (b"     14000,         0,K,K,R", b"-    14000,-        7,X,L,B", b"    -14000, 123456789,K,W,R"),
            _shot_says,
        ),
        Decoder("SHOT word", sigma_koki._word_or_not_ours, (b"OK", b"NG"), lambda line, word: line.decode() == word),
        Decoder("SHOT version", sigma_koki.find_version, (b"V1.20", b"SHOT-302GS V1.04"), lambda line, told: line.decode().strip() == told),
        Decoder(
            "Keithley reading",
            keithley6485.parse_reading,
            (
                b"+1.040564E-06A,+2.236299E+02,+1.380000E+02",  # sheet 5.1
                b"-1.236000E-12A,+9.999999E+04,+1.024000E+03",
                b"+9.9E37A,+2.236299E+02,+1.000000E+00",
                b"+9.91E37A,+2.236299E+02,+0.000000E+00",
                b"+1.000000E-09A,+2.236299E+02,+5.120000E+02",
            ),
            _keithley_says,
        ),
        Decoder(
            "Keithley identity",
            keithley6485.parse_identity,
            (b"KEITHLEY INSTRUMENTS INC.,MODEL 6485,4038279,C01   Jun 23 2010 12:22:00/A02  /H",),  # sheet 5.1
            _identity_says,
        ),
        Decoder("Keithley error", keithley6485._parse_error, (b'0,"No error"', b'-113,"Undefined header"'), _scpi_error_says),
        Decoder(
            "LS-100 reading",
            partial(konica_minolta.parse_reading, model="LS-100"),
            (b"OK00,   123.4", b"OK00,   .0123", b"OK12", b"OK13,   0.001", b"ER10", b"ER30"),  # sheet 5.2
            partial(_minolta_says, numbers=1),
        ),
        Decoder(
            "CS-100A reading",
            partial(konica_minolta.parse_reading, model="CS-100A"),
            (b"OK00,  123.4,.3100,.3300", b"OK11,  123.4,.3100,.3300", b"OK12", b"ER19"),  # sheet 5.2
            partial(_minolta_says, numbers=3),
        ),
        Decoder(
            "Minolta setting",
            konica_minolta._accept_setting,
            (b"OK00", b"ER01", b"OK00,   123.4"),
            lambda line, taken: taken and line.strip() == b"OK00",
        ),
        Decoder(
            "optoNCDT stream",
            _stream,
            (
                b"".join(triple(word) for word in (643, 32760, 64877, 65520, 262075)),
                b"OUTPUT RS422\r\n->" + triple(32760) + triple(32761, first=False) + triple(32762),
                triple(1) + b"OUTPUT NONE\r\n->" + triple(2)[:2],
            ),
            _stream_says,
        ),
        Decoder(
            "optoNCDT GETINFO",
            _infos,
            (INFO,),
            _infos_say,
        ),
        Decoder(
            "optoNCDT answer",
            lambda data: optoncdt1420._answers("MEASRATE 1", data),
            (b"MEASRATE 1\r\n", b"MEASRATE 1.000\r\n", b"E202 Access denied\r\n", b"MEASRATE 2\r\n"),
            _echo_says,
        ),
        Decoder(
            "Modbus input registers",
            _Registers(_input),
            _hex("01 04 04 7C37 428B", "01 84 02"),  # sheet 6.1
            lambda data, words: struct.pack(">HH", *words) in replies(data, 4, 4),
            with_crc,
        ),
        Decoder(
            "Modbus discrete inputs",
            _Registers(_discrete),
            _hex("01 02 02 05 02", "01 82 01"),
            lambda data, bits: any(
                tuple(each == "1" for each in f"{int.from_bytes(raw, 'little'):016b}"[::-1][:10]) == bits for raw in replies(data, 2, 2)
            ),
            with_crc,
        ),
        Decoder(
            "Modbus text",
            _Registers(_text),
            _hex("01 04 0A" + b"1.2.3".ljust(10, b"\0").hex(), "01 04 0A" + b"OM20-P0100".hex()),
            lambda data, told: any(raw.rstrip(b"\0 ") == told.encode("ascii") for raw in replies(data, 4, 10)),
            with_crc,
        ),
        Decoder(
            "Modbus write of one register",
            _Registers(_write),
            _hex("01 06 00 7D 00 20", "01 86 04"),  # sheet 0
            lambda data, taken: bytes.fromhex("01 06 00 7D 00 20 18 0A") in data,
            with_crc,
        ),
        Decoder(
            "Modbus write of many registers",
            _Registers(_write_many),
            _hex("01 10 00 58 00 10", "01 90 03"),
            lambda data, taken: with_crc(bytes.fromhex("01 10 00 58 00 10")) in data,
            with_crc,
        ),
        Decoder(
            "AZ outputs and alarm",
            _Registers(_az, others={0x00CC: "01 03 04 0000 2134"}),
            _hex("01 03 08 0000 2010 0000 0000", "01 03 08 0000 0080 0000 0030", "01 03 08 0000 0070 0000 0000"),
            _az_outputs_say,
            with_crc,
        ),
        Decoder(
            "AZ position",
            _Registers(_az, others={0x007E: "01 03 08 0000 0030 0000 0000"}),
            _hex("01 03 04 0000 2134", "01 03 04 FFFF FFFE"),
            _az_position_says,
            with_crc,
        ),
        Decoder(
            "Apogee flux",
            _Registers(_apogee, others={10: "01 03 04 0000 0000"}),
            _hex("01 03 04 449A 522B", "01 03 04 4610 0000", "01 03 04 7FC0 0000", "01 03 04 BF80 0000"),
            _apogee_says,
            with_crc,
        ),
        Decoder(
            "Baumer measurements",
            _Registers(_baumer, first=BLOCK.format(1)),
            (
                *_hex(BLOCK.format(2)),
                *_hex(BLOCK.format(3).replace("7C37 428B", "0000 7FC0")),
                *_hex(BLOCK.format(4).replace("0000 0001", "0001 0003")),
            ),
            _baumer_says,
            with_crc,
        ),
    )
