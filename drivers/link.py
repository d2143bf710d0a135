"""One request-reply link over a serial port or a socket, shared by every device on that port.

Lines end with a terminator. Requests take turns; only an urgent one (a stop) goes on the wire while another thread still
waits. So that the two replies cannot be mixed up, whichever thread happens to be reading hands every line to the request
that claims it.
"""

from __future__ import annotations

import io
import logging
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from drivers.errors import BadChecksum, DeviceError, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.incidents import Incident, Report, What, in_hex, story

if TYPE_CHECKING:
    import serial

T = TypeVar("T")
S = TypeVar("S")
Traffic = Callable[[float, Literal["tx", "rx"], bytes], None]

log = logging.getLogger(__name__)

TERMINATORS = {"CR": b"\r", "LF": b"\n", "CRLF": b"\r\n", "LFCR": b"\n\r"}

_REOPEN = "check the cable and the device's power, then open the port again"
_CHUNK = 4096
_SLICE_S = 0.05  # how soon a waiting thread notices that the link was closed under it
_STALE_CHUNKS = 64  # a device that babbles for ever must not hold up the request
_SKIPPED_LINES = 8  # lines nobody claimed, kept for error messages and reports


class Witness:
    """Tells a callback of the traffic on a port, and keeps what it raises from the port.

    Parameters
    ----------
    traffic : callable, optional
        See `Link`.
    url : str
        Of the port, for the log.
    """

    def __init__(self, traffic: Traffic | None, url: str) -> None:
        self._traffic = traffic
        self._url = url
        self._failed = False

    def saw(self, time_s: float, direction: Literal["tx", "rx"], data: bytes) -> None:
        """Tell that bytes passed; the first failure is logged."""
        if self._traffic is None:
            return
        try:
            self._traffic(time_s, direction, data)
        except Exception:
            if not self._failed:
                self._failed = True
                log.exception("traffic on %s is not told", self._url)


class _Waiting(Generic[T]):
    """A request on the wire and, once it has come, its reply."""

    def __init__(self, accept: Callable[[bytes], T | None]) -> None:
        self._accept = accept
        self.reply: T | None = None
        self.error: DeviceError | None = None
        self.skipped: list[bytes] = []

    @property
    def done(self) -> bool:
        return self.reply is not None or self.error is not None

    def offer(self, frame: bytes) -> bool:
        """Say whether this line was ours, for good or ill."""
        try:
            self.reply = self._accept(frame)
        except DeviceError as error:
            error.raw = error.raw or frame
            self.error = error
        if not self.done:
            self.skipped = [*self.skipped[1 - _SKIPPED_LINES :], frame]
        return self.done


class Link:
    """A port and the discipline of using it; safe to use from any thread.

    Parameters
    ----------
    port : serial.SerialBase
        An open pyserial port with ``timeout=0``. `Link.open` makes one from a URL.
    url : str
        What the port is called in messages.
    device : str
        What the device is called in messages when a request does not say.
    timeout_s : float, s
        Time allowed for a reply when a request does not say.
    terminator : bytes
        What ends each line the device sends.
    traffic : callable, optional
        Called with (monotonic time in s, ``"tx"`` or ``"rx"``, bytes) for all that has passed, from whichever thread handles it; it
        must be quick. Bytes are told once they are on their way, so an answer to one thread's urgent request may be told before the
        request by another: the times are in order. What it raises is logged once and goes no further.
    report : callable, optional
        Called with an `Incident` whenever the link did something about trouble: sent a request again, resynchronised, dropped input.
        It is called between exchanges, never with a request on the wire of the same thread. What it raises is logged and goes no further.

    Attributes
    ----------
    unasked : tuple of bytes
        Beginnings of lines that the device sends on its own: to drop such lines is no incident.
    """

    def __init__(
        self,
        port: serial.SerialBase,
        *,
        url: str,
        device: str = "",
        timeout_s: float = 1.0,
        terminator: bytes = b"\r\n",
        traffic: Traffic | None = None,
        report: Report | None = None,
    ) -> None:
        self.url = url
        self.device = device
        self.timeout_s = timeout_s
        self.terminator = terminator
        self.unasked: tuple[bytes, ...] = ()
        self._port = port
        self._witness = Witness(traffic, url)
        self._report = report
        self._turn = threading.Lock()  # held for a whole ordinary exchange
        self._write_lock = threading.Lock()  # held only while bytes go out
        self._state = threading.Lock()  # guards the next four
        self._waiting: list[_Waiting[Any]] = []  # in the order sent
        self._strays: deque[tuple[What, bytes]] = deque(maxlen=_SKIPPED_LINES)  # input nobody claimed, not yet reported
        self._reading = False  # one thread at a time reads the port, and owns the buffer, for all that wait
        self._closed = False
        self._changed = threading.Condition(self._state)
        self._buffer = b""
        self._shared: dict[Callable[[Link], Any], Any] = {}
        self._fd = _file_descriptor(port)
        if self._fd is None:
            port.timeout = _SLICE_S
        # Straight from the system where possible: pyserial's read() asks a second time whether there is anything to read.
        self._read = partial(os.read, self._fd) if self._fd is not None and os.name == "posix" else port.read

    @classmethod
    def open(
        cls,
        url: str,
        *,
        device: str = "",
        timeout_s: float = 1.0,
        terminator: bytes = b"\r\n",
        traffic: Traffic | None = None,
        report: Report | None = None,
        **settings: Any,
    ) -> Link:
        """Open a port by name (``/dev/ttyUSB0``, ``COM3``) or URL (``socket://host:port``, ``rfc2217://...``).

        Parameters
        ----------
        settings
            Passed to `serial.serial_for_url`: ``baudrate``, ``bytesize``, ``parity``, ``stopbits``, ``xonxoff``, ``rtscts``.

        Raises
        ------
        TransportTimeout
            The port is absent, busy or refuses the connection.
        InvalidSetting
            The URL or a setting means nothing to pyserial.
        """
        import serial

        if not terminator or timeout_s <= 0:
            given = f"terminator {terminator!r}, timeout {timeout_s} s"
            raise InvalidSetting(given, device=device, port=url, expected="a terminator, and a timeout above 0")
        attempt = "opening the port"
        try:
            # exclusive: a second program on the same port would steal half of the replies
            port = serial.serial_for_url(url, timeout=0, write_timeout=timeout_s, exclusive=True, **settings)
        except OSError as error:
            hint = "check that it is plugged in, powered, and not in use by another program"
            raise TransportTimeout(str(error), device=device, port=url, attempt=attempt, hint=hint) from error
        except Exception as error:  # pyserial lets ValueError, TypeError and termios.error through
            raise InvalidSetting(f"{type(error).__name__}: {error}", device=device, port=url, attempt=attempt) from error
        if url.startswith("socket://"):
            _send_small_packets_at_once(port.fileno())
        return cls(port, url=url, device=device, timeout_s=timeout_s, terminator=terminator, traffic=traffic, report=report)

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port; threads that wait on it get `PortClosed`. Closing twice is harmless."""
        with self._state:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
            while self._reading:
                self._changed.wait()
        with self._write_lock:
            self._port.close()

    def shared(self, kind: Callable[[Link], S]) -> S:
        """Return what all devices of a kind on this link have in common: made by `kind` of the link for the first, the same for the others.

        Axes are opened one by one, yet their controller may have one line of answers, one error queue, one busy flag.
        """
        with self._state:
            if kind not in self._shared:
                self._shared[kind] = kind(self)
            found: S = self._shared[kind]
        return found

    def exchange(
        self,
        request: bytes,
        accept: Callable[[bytes], T | None],
        *,
        attempt: str,
        expected: str,
        device: str = "",
        timeout_s: float | None = None,
        repeatable: bool = False,
        urgent: bool = False,
        veto: Callable[[], DeviceError | None] | None = None,
    ) -> T:
        """Send a request and wait for its reply.

        Parameters
        ----------
        request : bytes
            The whole request, terminator included.
        accept : callable
            Given each line received, without its terminator: returns the reply, or None if the line belongs to somebody else
            (a late answer, an alert), or raises a `DeviceError` if the line is ours and wrong. Must not use the link.
        attempt, expected : str
            What is being done and what should come back, for messages.
        device : str
            Who is being asked, for messages.
        timeout_s : float, s, optional
            Time allowed for this reply.
        repeatable : bool
            Whether the request may be sent once more when its reply is missing or damaged. Never for anything that moves.
        urgent : bool
            Send at once, even while another thread waits for its reply. The replies must then be distinguishable by `accept`.
        veto : callable, optional
            Asked at the last moment, when no other bytes can go out any more: an error it returns is raised and nothing is sent.
            So a motion that queued for its turn while a stop overtook it can be dropped.

        Raises
        ------
        TransportTimeout
            No complete line that `accept` took came in time; what did come is in `raw`.
        PortClosed
            The port was unplugged or closed.
        DeviceError
            Whatever `accept` raised.
        """
        allowed_s = self.timeout_s if timeout_s is None else timeout_s
        started = time.monotonic()

        def once() -> T:
            with nullcontext() if urgent else self._turn:
                reading = self._take_reading()
                try:
                    if reading:
                        self._drop_stale_input()
                    return self._send_and_wait(request, accept, allowed_s, veto, reading=reading)
                finally:
                    if reading:
                        self._leave_reading()

        try:
            try:
                return once()
            except (TransportTimeout, BadChecksum, UnexpectedReply) as error:
                if not repeatable:
                    raise
                self._tell_of_strays(device, attempt)
                self.tell("repeated", story(error), device=device, attempt=attempt)
            return once()
        except DeviceError as error:
            elapsed_s = time.monotonic() - started
            device = device or self.device
            error.complete(device=device, port=self.url, attempt=attempt, expected=expected, elapsed_s=elapsed_s)
            raise
        finally:
            if self._strays:
                self._tell_of_strays(device, attempt)

    def tell(self, what: What, detail: str, *, device: str = "", attempt: str = "") -> None:
        """Report an incident; that must never spoil an exchange."""
        if self._report is None:
            return
        incident = Incident(time.time(), self.url, device or self.device, attempt, what, detail)
        try:
            self._report(incident)
        except Exception:
            log.exception("not reported: %s", incident)

    def _tell_of_strays(self, device: str, attempt: str) -> None:
        with self._state:
            strays = tuple(self._strays)
            self._strays.clear()
        kinds: tuple[What, ...] = ("stale bytes dropped", "foreign line passed over")
        for kind in kinds:
            data = b"".join(line for what, line in strays if what == kind)
            if data:
                self.tell(kind, in_hex(data), device=device, attempt=attempt)

    def _send_and_wait(
        self,
        request: bytes,
        accept: Callable[[bytes], T | None],
        allowed_s: float,
        veto: Callable[[], DeviceError | None] | None,
        *,
        reading: bool,
    ) -> T:
        waiting = _Waiting(accept)
        with self._write_lock:
            objection = veto() if veto is not None else None
            if objection is not None:
                raise objection
            with self._state:
                self._waiting.append(waiting)
            sent_s = time.monotonic()
            try:
                self._send(request)
            except BaseException:
                self._forget(waiting)
                raise
        try:
            self._witness.saw(sent_s, "tx", request)  # only now: a log that waits for its disk must not keep a stop from going out
            deadline = time.monotonic() + allowed_s
            if reading:
                self._read_for(waiting, deadline)
            else:
                self._wait_for(waiting, deadline)
            if waiting.error is not None:
                raise waiting.error
            if waiting.reply is None:
                raise self._timeout(waiting)
            return waiting.reply
        except DeviceError as error:
            error.complete(sent=request)
            raise
        finally:
            self._forget(waiting)

    def _forget(self, waiting: _Waiting[Any]) -> None:
        with self._state:
            self._waiting.remove(waiting)

    def _timeout(self, waiting: _Waiting[Any]) -> TransportTimeout:
        partial = self._buffer
        raw = b"".join(line + self.terminator for line in waiting.skipped) + partial
        if partial:
            problem = self._other_end(raw) or f"the reply broke off before its terminator ({self.terminator.hex(' ')})"
        elif waiting.skipped:
            problem = "no reply to this request, only other lines"
        else:
            problem = "no reply"
        return TransportTimeout(problem, raw=raw, hint="check power, cable, address and line settings")

    def _other_end(self, raw: bytes) -> str:
        """What to say of a reply that ends a line otherwise than this link does; nothing of one that just broke off."""
        names = {end: name for name, end in TERMINATORS.items()}
        ended = next((end for end in sorted(names, key=len, reverse=True) if raw.endswith(end)), b"")
        if not ended or self.terminator not in names:
            return ""
        perhaps = "if it always does, " if self.terminator.startswith(ended) else ""
        told, expected = f"{names[ended]} ({ended.hex(' ')})", names[self.terminator]
        return f'the reply ended in {told}, not {expected}: {perhaps}set terminator = "{names[ended]}"'

    def _take_reading(self) -> bool:
        """Become the thread that reads, unless there is one."""
        with self._state:
            taken = not self._reading
            self._reading = True
        return taken

    def _leave_reading(self) -> None:
        with self._state:
            self._reading = False
            if self._waiting or self._closed:
                self._changed.notify_all()

    def _wait_for(self, waiting: _Waiting[Any], deadline: float) -> None:
        """Return when the reply is there or the deadline has passed, taking over the reading when nobody does it."""
        with self._state:
            while self._reading and not waiting.done:
                remaining = deadline - time.monotonic()
                if remaining <= 0:
                    return
                self._changed.wait(remaining)
            if waiting.done:
                return
            self._reading = True
        try:
            self._read_for(waiting, deadline)
        finally:
            self._leave_reading()

    def _read_for(self, waiting: _Waiting[Any], deadline: float) -> None:
        while not waiting.done:
            remaining = deadline - time.monotonic()
            chunk = self._receive(min(max(remaining, 0.0), _SLICE_S))
            if chunk:
                self._distribute(chunk)
            elif remaining <= 0:  # looked once more after the deadline: a busy computer must not look like a dead device
                return

    def _distribute(self, chunk: bytes) -> None:
        *frames, self._buffer = (self._buffer + chunk).split(self.terminator)
        with self._state:
            for frame in frames:
                claimed = any(waiting.offer(frame) for waiting in self._waiting if not waiting.done)
                if not claimed:
                    self._note_stray(frame + self.terminator)
                elif len(self._waiting) > 1:
                    self._changed.notify_all()

    def _note_stray(self, data: bytes) -> None:
        if not data.startswith(self.unasked):
            self._strays.append(("foreign line passed over" if self._waiting else "stale bytes dropped", data))

    def _drop_stale_input(self) -> None:
        """Drop what came before the question, for it cannot be the answer; except what an urgent request is waiting for."""
        for _ in range(_STALE_CHUNKS):
            chunk = self._receive(0.0)
            if not chunk:
                break
            self._distribute(chunk)
        if not self._waiting and self._buffer:
            with self._state:
                self._note_stray(self._buffer)
            self._buffer = b""

    def _receive(self, wait_s: float) -> bytes:
        """Whatever the port has, waiting at most this long for the first byte."""
        if self._closed:
            raise PortClosed("the link was closed")
        try:
            if self._fd is None:
                chunk = self._receive_without_descriptor(wait_s)
            elif not select.select([self._fd], [], [], wait_s)[0]:
                return b""
            elif not (chunk := self._read(_CHUNK)):
                raise PortClosed("the other end hung up", hint=_REOPEN)
        except BlockingIOError:  # select woke for nothing
            return b""
        except OSError as error:
            raise _lost(error) from error
        if chunk:
            self._witness.saw(time.monotonic(), "rx", chunk)
        return chunk

    def _receive_without_descriptor(self, wait_s: float) -> bytes:
        there: int = self._port.in_waiting  # type: ignore[attr-defined]  # every port has it, SerialBase does not declare it
        # read() itself waits for one slice, the timeout these ports are given
        return self._port.read(max(there, 1)) if there or wait_s > 0 else b""

    def _send(self, request: bytes) -> None:
        if self._closed:
            raise PortClosed("the link was closed")
        try:
            self._port.write(request)
        except OSError as error:
            from serial import SerialTimeoutException

            if isinstance(error, SerialTimeoutException):
                raise TransportTimeout("the port takes no more bytes", hint="check flow control and cable") from error
            raise _lost(error) from error


def _lost(error: OSError) -> PortClosed:
    return PortClosed(f"the port is gone: {error}", hint=_REOPEN)


def _file_descriptor(port: serial.SerialBase) -> int | None:
    """Number to wait on, or None for ports that have none (rfc2217, loop, COM ports)."""
    try:
        return int(port.fileno())
    except (AttributeError, io.UnsupportedOperation):
        return None


def _send_small_packets_at_once(fd: int) -> None:
    """Switch Nagle's algorithm off: it would hold a short request back until the last one is acknowledged."""
    twin = socket.socket(fileno=os.dup(fd))
    try:
        twin.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    finally:
        twin.close()
