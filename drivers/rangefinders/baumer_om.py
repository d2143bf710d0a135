"""Baumer OM20 and OM30 laser distance sensors over RS-485, Modbus RTU.

Source: the project's protocol sheet, section 6.1 (OM20 manual, p10 to 47). Numbers of 32 bits come low word first; a register can only be
read or written together with all others of its parameter, except that the measurements from 200 on may be read as one block.

The sensor measures all the time and, when it loses its target, goes on telling the last distance for its dropout time, then NaN. So that no
distance is told twice, that time is set to 0, and a reading is taken from a block with another timestamp than the one before it.

Not verified: whether a weak signal can be trusted (`weak_is_good`), what the alarm means (such a reading is doubtful), that the dropout
time is one register, whether the timestamp changes with each measurement, and whether the measuring range is told from the same zero as the
distances when a zero position was taught. What precision and trigger mode mean is not known either, so neither is touched.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from typing import Protocol

from drivers.errors import InvalidSetting, UnexpectedReply
from drivers.kinds import DistanceReading, Identity
from drivers.link import Link
from drivers.modbus import ModbusUnit, text

MEASUREMENTS, MEASUREMENTS_COUNT = 200, 13
"""Quality, outputs, distance, rate, exposure reserve, response delay, and the timestamp in s and in us (input registers)."""

VENDOR, PRODUCT, SERIAL_NUMBER, FIRMWARE = (0, 16), (32, 26), (95, 10), (110, 5)
NEAR, FAR, DROPOUT_MS = 200, 202, 800

QUALITIES = ("", "weak", "critical")
ALARM = 1 << 1
POLL_S = 0.002
_FARTHEST_MM = 1e4  # beyond any of these sensors, so that a number in the wrong order of words is noticed


def judge(quality: int, outputs: int, distance_mm: float, device_time_s: float, *, weak_is_good: bool = False) -> DistanceReading:
    """Make a reading of the registers from 200 on; NaN is no target, a weak or critical signal and an alarm make it doubtful.

    Raises
    ------
    UnexpectedReply
        The quality is not 0, 1 or 2, or no sensor measures so far.
    """
    if quality >= len(QUALITIES):
        raise UnexpectedReply(f"quality {quality}", expected="0, 1 or 2")
    flags = (QUALITIES[quality],) if quality else ()
    if outputs & ALARM:
        flags = (*flags, "alarm")
    if math.isnan(distance_mm):
        flags = (*flags, "no_target")
        return DistanceReading(math.inf, status=quality, out_of_range=True, device_time_s=device_time_s, flags=flags)
    if not abs(distance_mm) < _FARTHEST_MM:
        raise UnexpectedReply(f"a distance of {distance_mm:g} mm", expected=f"less than {_FARTHEST_MM:g} mm, or NaN")
    doubtful = bool(outputs & ALARM) or quality > int(weak_is_good)
    return DistanceReading(distance_mm, status=quality, doubtful=doubtful, device_time_s=device_time_s, flags=flags)


class Clock(Protocol):
    """Where time comes from; the `time` module is one."""

    def monotonic(self) -> float:
        """Seconds, never going backwards."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait."""
        ...


class BaumerOM:
    """The sensor as a range finder; satisfies `drivers.kinds.RangeFinder`. Others may share its bus.

    `BaumerOM.open` sets the sensor up; the bare constructor sends nothing.

    Parameters
    ----------
    link : ModbusLink
        57600 baud, 8 data bits, even parity, 1 stop bit as delivered. Stays the caller's to close.
    name : str
        For messages.
    address : int
        On the bus, 1 as delivered.
    weak_is_good : bool
        Trust a distance measured with a weak signal; not verified, hence off. A critical one is never trusted.
    fresh_s : float, s
        Time allowed for a new measurement.
    clock
        To wait with for a new measurement.
    """

    def __init__(
        self, link: Link, name: str, *, address: int = 1, weak_is_good: bool = False, fresh_s: float = 1.0, clock: Clock = time
    ) -> None:
        if not 0 < fresh_s < math.inf:
            raise InvalidSetting(f"fresh_s {fresh_s}", device=name, expected="a finite time above 0")
        self._link = link
        self._unit = ModbusUnit(link, name, address, high_word_first=False)
        self._weak_is_good, self._fresh_s, self._clock = weak_is_good, fresh_s, clock
        self._limits: tuple[float, float] | None = None
        self._lock = threading.RLock()

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        address: int = 1,
        weak_is_good: bool = False,
        fresh_s: float = 1.0,
        dropout_ms: int | None = 0,
    ) -> BaumerOM:
        """Make sure that a Baumer sensor is there, read its measuring range and set its dropout time.

        Parameters
        ----------
        dropout_ms : int, ms, optional
            For how long a lost target's last distance is told; above 0 such a reading passes for a good one. Left alone when not given.

        Raises
        ------
        UnexpectedReply
            Another device, or one that did not keep the dropout time.
        ModbusRefusal
            The sensor refuses the dropout time.
        """
        if dropout_ms is not None and not 0 <= dropout_ms <= 0xFFFF:
            raise InvalidSetting(f"dropout_ms {dropout_ms}", device=name, expected="0 to 65535 ms, or none to leave it alone")
        sensor = cls(link, name, address=address, weak_is_good=weak_is_good, fresh_s=fresh_s)
        identity = sensor.identify()
        if "baumer" not in identity.vendor.lower():
            raise sensor._unit.unexpected(f"vendor {identity.vendor!r}", "asking for the identity", "Baumer")
        sensor.limits_mm()
        if dropout_ms is not None:
            sensor._set_dropout(dropout_ms)
        return sensor

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._unit.name

    def identify(self) -> Identity:
        """Read vendor, product, serial number and firmware."""
        with self._lock:
            parts = [text(self._unit.input(*where, "asking for the identity")) for where in (VENDOR, PRODUCT, SERIAL_NUMBER, FIRMWARE)]
        return Identity(*parts)

    def limits_mm(self) -> tuple[float, float]:
        """Near and far end of the measuring range as set in the sensor, mm; asked once.

        Raises
        ------
        UnexpectedReply
            They are no such distances.
        """
        with self._lock:
            if self._limits is None:
                attempt = "asking for the measuring range"
                ends = [self._unit.float32(self._unit.holding(address, 2, attempt))[0] for address in (NEAR, FAR)]
                near_mm, far_mm = ends
                if not -_FARTHEST_MM < near_mm < far_mm < _FARTHEST_MM:
                    raise self._unit.unexpected(f"from {near_mm:g} to {far_mm:g} mm", attempt, "a near and a far end")
                self._limits = near_mm, far_mm
            return self._limits

    def read(self) -> DistanceReading:
        """Wait for the next measurement and return it. A missing or garbled reply is asked for once more.

        Raises
        ------
        DeviceFault
            No new measurement comes: the laser is off, or the sensor waits for a trigger.
        UnexpectedReply
            The registers make no sense.
        """
        attempt = "measuring"
        with self._lock:
            before = self._measurements(attempt)
            deadline = self._clock.monotonic() + self._fresh_s
            while (now := self._measurements(attempt))[-4:] == before[-4:]:
                if self._clock.monotonic() >= deadline:
                    hint = "check that the laser is on and that no trigger is waited for"
                    raise self._unit.fault(f"no new measurement within {self._fresh_s:g} s", attempt, hint=hint)
                self._clock.sleep(POLL_S)
            return self._reading(now, attempt)

    def close(self) -> None:
        """Let go of the sensor. The link stays open for the others on it."""
        self._unit.closed = True

    def _measurements(self, attempt: str) -> Sequence[int]:
        return self._unit.input(MEASUREMENTS, MEASUREMENTS_COUNT, attempt)

    def _reading(self, words: Sequence[int], attempt: str) -> DistanceReading:
        quality, outputs = words[:2]
        (distance_mm,) = self._unit.float32(words[2:4])
        seconds, microseconds = self._unit.uint32(words[9:13])
        try:
            return judge(quality, outputs, distance_mm, seconds + 1e-6 * microseconds, weak_is_good=self._weak_is_good)
        except UnexpectedReply as error:
            error.complete(device=self.name, port=self._link.url, attempt=attempt)
            raise

    def _set_dropout(self, dropout_ms: int) -> None:
        attempt = f"setting the dropout time to {dropout_ms} ms"
        with self._lock:
            self._unit.write_one(DROPOUT_MS, dropout_ms, attempt, repeatable=True)
            (kept,) = self._unit.holding(DROPOUT_MS, 1, attempt)
        if kept != dropout_ms:
            raise self._unit.unexpected(f"a dropout time of {kept} ms", attempt, f"{dropout_ms} ms")
