"""Modbus RTU over a serial port or a socket: one link that several devices share, and one device at its address.

Source: MODBUS Application Protocol V1.1b3 and MODBUS over Serial Line V1.02. Requests, replies and checksums are pymodbus's, with
``retries=0``, for its default would send a motion command again; the port is a `drivers.link.Link`, which traces every byte.

A reply carries no message number. One is taken for ours only when address, function code, length, what it must echo and the checksum
all fit; anything else that comes is passed over until the time allowed is up. On adapters that echo what is sent, `ModbusUnit.write_one`
and `ModbusUnit.echo` cannot tell the echo from the reply; the other requests can.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pymodbus.client import ModbusSerialClient
from pymodbus.framer import FramerRTU
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.bit_message import ReadDiscreteInputsRequest
from pymodbus.pdu.diag_message import ReturnQueryDataRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from drivers.endpoint import Endpoint, Veto
from drivers.errors import BadChecksum, DeviceError, DeviceFault, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.incidents import in_hex, story
from drivers.link import Link

MOST_READ = 125
MOST_WRITTEN = 123
"""Registers in one request. Source: Application Protocol V1.1b3, 6.3 and 6.12."""

_MEANINGS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, still working",
    6: "device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}
_BITS_PER_CHARACTER = 11  # start, eight bits, parity and stop
_GIVE_WAY_S = 0.025  # how long a stop lets the exchange under way go on, beside the time its bytes need
_SETTLE_S = 0.05  # silence asked for after a failure: a late reply must not meet the next request
_SLICE_S = 0.01
_STALE_CHUNKS = 64


class ModbusRefusal(DeviceFault):
    """The device answered with a Modbus exception.

    Attributes
    ----------
    code : int
        Exception code: 1 illegal function, 2 illegal data address, 3 illegal data value, 4 device failure, 6 busy.
    """

    def __init__(self, problem: str, *, code: int = 0, **context: Any) -> None:
        super().__init__(problem, **context)
        self.code = code


class _ReplyFramer(FramerRTU):
    """Picks the one frame that can be the reply to the request under way out of all bytes that came since it was sent."""

    head = b""  # what the reply's function code and data begin with
    length = 0  # of function code and data
    passed_over = b""  # what came before and after the reply

    def await_reply_to(self, request: ModbusPDU) -> None:
        """Know the reply by its request. Source: Application Protocol V1.1b3, 6."""
        function, data = bytes([request.function_code]), request.encode()
        if isinstance(request, ReadDiscreteInputsRequest):
            count = -(-request.count // 8)
            self.head, self.length = function + bytes([count]), 2 + count
        elif isinstance(request, ReadHoldingRegistersRequest):  # also the parent of input registers
            self.head, self.length = function + bytes([2 * request.count]), 2 + 2 * request.count
        elif isinstance(request, ReturnQueryDataRequest):
            self.head, self.length = function + data, 1 + len(data)
        else:
            self.head, self.length = function + data[:4], 5

    def handleFrame(self, data: bytes, exp_devid: int, exp_tid: int) -> tuple[int, ModbusPDU | None]:
        """Return the bytes used up, none, and the reply if it is there."""
        address, refusal = bytes([exp_devid]), bytes([self.head[0] | 0x80])
        for head, length in ((address + self.head, self.length), (address + refusal, 2)):
            start = data.find(head)
            while 0 <= start <= len(data) - length - 3:
                frame = data[start : start + length + 3]
                pdu = self.decode(frame)[3]  # empty when the checksum is wrong
                reply = self.decoder.decode(pdu) if len(pdu) == length else None
                if reply is not None:
                    reply.dev_id, reply.transaction_id = exp_devid, exp_tid
                    self.passed_over = data[:start] + data[start + len(frame) :]
                    return len(data), reply
                start = data.find(head, start + 1)
        return 0, None


class _Client(ModbusSerialClient):
    """pymodbus's client on the port of a link."""

    def __init__(self, link: ModbusLink) -> None:
        super().__init__(link.url, timeout=math.inf, retries=0, trace_packet=self._keep)  # `recv` knows the time allowed
        self.framer = self.transaction.framer = _ReplyFramer(self.framer.decoder)
        self._link = link
        self.sent = b""
        self.heard = b""
        self.deadline = 0.0

    def ask(self, request: ModbusPDU, allowed_s: float) -> ModbusPDU:
        """Send a request and wait for its reply."""
        assert isinstance(self.framer, _ReplyFramer)
        self.framer.await_reply_to(request)
        self.sent = self.heard = self.framer.passed_over = b""
        self.deadline = time.monotonic() + allowed_s
        return self.execute(False, request)

    def _keep(self, sending: bool, data: bytes) -> bytes:
        """Keep the request, and all that came since; pymodbus hands the latter over whole each time."""
        if sending:
            self.sent = data
        else:
            self.heard = data
        return data

    def connect(self) -> bool:
        """Say that the port is open: the link has seen to it."""
        return True

    def close(self) -> None:
        """Leave the port to the link."""

    def send(self, request: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Send bytes."""
        self._link._send_frame(request)
        return len(request)

    def recv(self, size: int | None) -> bytes:
        """Wait for bytes.

        Raises
        ------
        DeviceError
            Why none came, or none that fit, before the time was up.
        """
        while True:
            remaining = self.deadline - time.monotonic()
            self._link._give_way()
            chunk = self._link._receive(min(max(remaining, 0.0), _SLICE_S))
            if chunk:
                return chunk
            if remaining <= 0:
                raise self._what_came()

    def _what_came(self) -> DeviceError:
        framer, heard, unit = self.framer, self.heard, self.transaction.request_dev_id
        assert isinstance(framer, _ReplyFramer)
        if not heard:
            return TransportTimeout("no reply", hint="check power, cable, address and line settings")
        if len(heard) > 3 and framer.check_CRC(heard[:-2], int.from_bytes(heard[-2:], "big")):
            problem = "a reply to another request" if heard[0] == unit else f"a reply from address {heard[0]}"
            return UnexpectedReply(problem, raw=heard, hint="is another master on this bus, or do two devices have one address?")
        shortest = 5 if len(heard) > 1 and heard[1] == framer.head[0] | 0x80 else framer.length + 3
        if len(heard) >= shortest:
            return BadChecksum("no reply with a right checksum", raw=heard, hint="check cable, termination and line settings")
        return TransportTimeout("the reply broke off", raw=heard, hint="check cable, termination and line settings")


class ModbusLink(Link):
    """A port with Modbus RTU devices on it; safe to use from any thread. `ModbusLink.open` makes one from a URL, as for `Link`.

    Requests take turns. An urgent one (a stop) goes before all that queue, and cuts short the wait for a reply that does not come:
    within 25 ms and the time the bytes on the wire need.
    """

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        baud = self._port.baudrate
        self._character_s = _BITS_PER_CHARACTER / baud
        # Source: Serial Line V1.02, 2.5.1.1: three and a half characters, and never less than 1.75 ms.
        self._gap_s = max(3.5 * self._character_s, 1.75e-3)
        self._silent_since = 0.0  # when the last byte had passed, as far as is known
        self._unsettled = ""  # what went wrong, until the line has been silent
        self._urgent = 0  # how many urgent requests queue
        self._give_way_at = 0.0
        self._client = _Client(self)

    def ask(
        self,
        request: ModbusPDU,
        *,
        attempt: str,
        device: str = "",
        timeout_s: float | None = None,
        repeatable: bool = False,
        urgent: bool = False,
        veto: Veto | None = None,
    ) -> ModbusPDU:
        """Send a request and wait for its reply; the keywords are those of `Link.exchange`.

        Raises
        ------
        TransportTimeout
            Nothing came in time, or only the beginning of a reply, or a stop was more urgent.
        BadChecksum
            What came was damaged.
        UnexpectedReply
            Another device answered, or this one answered something else.
        ModbusRefusal
            The device says no.
        PortClosed
            The port was unplugged or closed.
        """
        started = time.monotonic()
        allowed_s = self.timeout_s if timeout_s is None else timeout_s
        try:
            try:
                reply = self._ask_once(request, allowed_s, urgent, veto, device, attempt)
            except (TransportTimeout, BadChecksum, UnexpectedReply) as error:
                if not repeatable:
                    raise
                self.tell("repeated", story(error), device=device, attempt=attempt)
                reply = self._ask_once(request, allowed_s, urgent, veto, device, attempt)
            if reply.isError():
                code = reply.exception_code
                raise ModbusRefusal(f"refused with exception {code:02X}h ({_MEANINGS.get(code, 'unknown')})", code=code)
        except DeviceError as error:
            expected = f"a reply from address {request.dev_id} to function {request.function_code:02X}h"
            elapsed_s = time.monotonic() - started
            error.complete(device=device or self.device, port=self.url, attempt=attempt, expected=expected, elapsed_s=elapsed_s)
            raise
        return reply

    def _ask_once(self, request: ModbusPDU, allowed_s: float, urgent: bool, veto: Veto | None, device: str, attempt: str) -> ModbusPDU:
        cause = stale = passed_over = ""
        try:
            with self._my_turn(urgent):
                objection = veto() if veto is not None else None
                if objection is not None:
                    raise objection
                silent, stale = self._drop_what_is_late(urgent)
                if silent:
                    cause, self._unsettled = self._unsettled, ""
                try:
                    reply = self._client.ask(request, allowed_s)
                except DeviceError as error:
                    self._unsettled = story(error)
                    error.complete(sent=self._client.sent)
                    raise
                passed_over = self._passed_over()
                return reply
        finally:  # when others can have their turn
            if stale:
                self.tell("stale bytes dropped", stale, device=device, attempt=attempt)
            if cause:
                self.tell("resynchronised", f"by silence on the line after {cause}", device=device, attempt=attempt)
            if passed_over:
                self.tell("foreign line passed over", passed_over, device=device, attempt=attempt)

    def _passed_over(self) -> str:
        """What came with the reply and is not it, in hex; an adapter's echo of the request is no incident."""
        assert isinstance(self._client.framer, _ReplyFramer)
        others = self._client.framer.passed_over
        return in_hex(others) if others != self._client.sent else ""

    @contextmanager
    def _my_turn(self, urgent: bool) -> Iterator[None]:
        with self._state:
            self._urgent += urgent
            try:
                while self._reading or (self._urgent and not urgent):
                    self._changed.wait()
                if self._closed:
                    raise PortClosed("the link was closed")
                self._reading = True
            finally:
                self._urgent -= urgent
                self._changed.notify_all()
        try:
            yield
        finally:
            with self._state:
                self._reading = False
                self._changed.notify_all()

    def _drop_what_is_late(self, urgent: bool) -> tuple[bool, str]:
        """Let the line fall silent as the protocol asks, and drop what comes meanwhile: it cannot be the answer.

        Returns whether that was long enough for all that was late, and what was dropped, in hex.
        """
        settling = bool(self._unsettled) and not urgent
        silence_s = _SETTLE_S if settling else self._gap_s
        dropped = b""
        for _ in range(_STALE_CHUNKS):  # a device that babbles for ever must not hold up the request
            wait_s = self._silent_since + silence_s - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            chunk = self._receive(0.0)
            if not chunk:
                return settling, in_hex(dropped)
            dropped += chunk
        return False, in_hex(dropped)

    def _send_frame(self, frame: bytes) -> None:
        sent_s = time.monotonic()
        self._send(frame)
        self._witness.saw(sent_s, "tx", frame)
        assert isinstance(self._client.framer, _ReplyFramer)
        self._silent_since = time.monotonic() + len(frame) * self._character_s
        self._give_way_at = self._silent_since + (self._client.framer.length + 3) * self._character_s + _GIVE_WAY_S

    def _receive(self, wait_s: float) -> bytes:
        chunk = super()._receive(wait_s)
        if chunk:
            self._silent_since = max(self._silent_since, time.monotonic())
        return chunk

    def _give_way(self) -> None:
        if self._urgent and time.monotonic() >= self._give_way_at:
            raise TransportTimeout("no reply before a stop had to go out", raw=self._client.heard, hint="ask the device for its state")


class ModbusUnit(Endpoint):
    """One device on a Modbus link, at its address.

    Parameters
    ----------
    link : ModbusLink
        Stays the caller's to close.
    name : str
        For messages.
    address : int
        1 to 247.
    high_word_first : bool
        Which register of a 32-bit number comes first; within a register the high byte always does.

    Raises
    ------
    InvalidSetting
        The address is out of range, or the link is not a Modbus one.
    """

    def __init__(self, link: Link, name: str, address: int = 1, *, high_word_first: bool = True) -> None:
        if not isinstance(link, ModbusLink):
            raise InvalidSetting("a link that does not speak Modbus", device=name, port=link.url, expected="a ModbusLink")
        if not 1 <= address <= 247:
            raise InvalidSetting(f"address {address}", device=name, port=link.url, expected="1 to 247")
        super().__init__(link, name)
        self.address = address
        self._modbus = link
        self._step = 1 if high_word_first else -1

    def holding(self, address: int, count: int, attempt: str) -> tuple[int, ...]:
        """Read holding registers (function 03h), 1 to 125."""
        return self._registers(ReadHoldingRegistersRequest, address, count, attempt)

    def input(self, address: int, count: int, attempt: str) -> tuple[int, ...]:
        """Read input registers (function 04h), 1 to 125."""
        return self._registers(ReadInputRegistersRequest, address, count, attempt)

    def discrete(self, address: int, count: int, attempt: str) -> tuple[bool, ...]:
        """Read discrete inputs (function 02h), 1 to 2000."""
        self._check(address, count, 2000, attempt)
        request = ReadDiscreteInputsRequest(dev_id=self.address, address=address, count=count)
        return tuple(self._ask(request, attempt, repeatable=True).bits[:count])

    def write(
        self,
        address: int,
        registers: Sequence[int],
        attempt: str,
        *,
        repeatable: bool = False,
        urgent: bool = False,
        veto: Veto | None = None,
    ) -> None:
        """Write 1 to 123 holding registers at once (function 10h). Never repeatable when it starts a motion."""
        self._check(address, len(registers), MOST_WRITTEN, attempt, registers)
        request = WriteMultipleRegistersRequest(dev_id=self.address, address=address, registers=list(registers))
        self._ask(request, attempt, repeatable=repeatable, urgent=urgent, veto=veto)

    def write_one(
        self, address: int, value: int, attempt: str, *, repeatable: bool = False, urgent: bool = False, veto: Veto | None = None
    ) -> None:
        """Write one holding register (function 06h). Never repeatable when it starts a motion."""
        self._check(address, 1, 1, attempt, (value,))
        request = WriteSingleRegisterRequest(dev_id=self.address, address=address, registers=[value])
        self._ask(request, attempt, repeatable=repeatable, urgent=urgent, veto=veto)

    def echo(self, attempt: str = "looking whether it is there") -> None:
        """Have two bytes sent back (function 08h, subfunction 0)."""
        self._ask(ReturnQueryDataRequest(b"\xa5\x37", dev_id=self.address), attempt, repeatable=True)

    def int32(self, words: Sequence[int]) -> tuple[int, ...]:
        """Signed numbers of two registers each."""
        return self._numbers(words, "i")

    def uint32(self, words: Sequence[int]) -> tuple[int, ...]:
        """Unsigned numbers of two registers each."""
        return self._numbers(words, "I")

    def float32(self, words: Sequence[int]) -> tuple[float, ...]:
        """Numbers of two registers each, NaN and infinity included: what they mean is the driver's to judge."""
        return self._numbers(words, "f")

    def words_of_int32(self, *values: int) -> tuple[int, ...]:
        """Two registers for each signed number.

        Raises
        ------
        InvalidSetting
            A number needs more than 32 bits.
        """
        return self._words(values, "i")

    def words_of_float32(self, *values: float) -> tuple[int, ...]:
        """Two registers for each number.

        Raises
        ------
        InvalidSetting
            A number is too large for 32 bits.
        """
        return self._words(values, "f")

    def _registers(self, kind: type[ReadHoldingRegistersRequest], address: int, count: int, attempt: str) -> tuple[int, ...]:
        self._check(address, count, MOST_READ, attempt)
        return tuple(self._ask(kind(dev_id=self.address, address=address, count=count), attempt, repeatable=True).registers)

    def _ask(
        self, request: ModbusPDU, attempt: str, *, repeatable: bool = False, urgent: bool = False, veto: Veto | None = None
    ) -> ModbusPDU:
        self.require_open(attempt)
        return self._modbus.ask(request, attempt=attempt, device=self.name, repeatable=repeatable, urgent=urgent, veto=veto)

    def _check(self, address: int, count: int, most: int, attempt: str, registers: Sequence[int] = ()) -> None:
        if not (0 <= address <= 0xFFFF and 1 <= count <= most and address + count <= 0x10000):
            expected = f"addresses 0 to 65535, 1 to {most} of them"
            raise InvalidSetting(f"{count} at address {address}", device=self.name, attempt=attempt, expected=expected)
        if not all(0 <= register <= 0xFFFF for register in registers):
            raise InvalidSetting(f"registers {list(registers)}", device=self.name, attempt=attempt, expected="0 to 65535 each")

    def _numbers(self, words: Sequence[int], code: str) -> tuple[Any, ...]:
        if len(words) % 2:
            raise InvalidSetting(f"{len(words)} registers", device=self.name, expected="two for each number")
        pairs = zip(words[::2], words[1::2], strict=True)
        return tuple(struct.unpack(f">{code}", struct.pack(">HH", *pair[:: self._step]))[0] for pair in pairs)

    def _words(self, values: Sequence[float], code: str) -> tuple[int, ...]:
        try:
            pairs = [struct.unpack(">HH", struct.pack(f">{code}", value))[:: self._step] for value in values]
        except (struct.error, OverflowError) as error:
            raise InvalidSetting(f"{values}", device=self.name, expected="numbers of 32 bits each") from error
        return tuple(word for pair in pairs for word in pair)


def text(words: Sequence[int]) -> str:
    """Text out of registers, two characters each; NULs and blanks at its end are cut off.

    Raises
    ------
    UnexpectedReply
        A character is not printable ASCII.
    """
    raw = b"".join(word.to_bytes(2, "big") for word in words).rstrip(b"\0 ")
    if not all(0x20 <= byte < 0x7F for byte in raw):
        raise UnexpectedReply("text that is not ASCII", raw=raw, expected="printable ASCII")
    return raw.decode("ascii")
