"""Apogee SQ-422X quantum sensor over Modbus RTU: photon flux, above all as a monitor of the lamp.

Source: the project's protocol sheet, section 5.4 (SQ-422X manual, p13 and 14). Numbers are floats in two holding registers, high word
first. Nothing is ever written to the sensor. Modbus answers do not say which register they are from, so readings are taken until two in
turn agree (`drivers.agreement`).

A quantum sensor takes light from a wide cone: for angle-resolved reflection it needs an aperture, and its floor may be too high for dark
angles. Not verified: how long the sensor averages (`response_s`), the end of its range (`full_scale`), what it answers for registers it
does not have, and that the status is 0 when it is not busy.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Protocol

from drivers.agreement import agreed
from drivers.errors import DeviceError, DeviceFault, InvalidSetting, UnexpectedReply
from drivers.kinds import Identity, LightReading
from drivers.link import Link
from drivers.modbus import ModbusUnit

UNIT = "umol/(m^2 s)"

OUTPUT, STATUS, FIRMWARE, ADDRESS = 0, 10, 12, 16
"""First register of a number; model and serial number follow the address."""

FLOOR = 1.0
"""umol/(m^2 s) by which two readings may differ in any case."""

READY, BUSY = 0, 1
POLL_S = 0.02


def judge(flux: float, full_scale: float) -> LightReading:
    """Make a reading of what the sensor tells, umol/(m^2 s): over range from the full scale on.

    Raises
    ------
    DeviceFault
        It is no number.
    UnexpectedReply
        It is ten times the full scale, either way.
    """
    if not math.isfinite(flux):
        raise DeviceFault(f"the sensor tells {flux}", hint="switch it off and on")
    if abs(flux) > 10 * full_scale:
        raise UnexpectedReply(f"a flux of {flux:g} {UNIT}", expected=f"at most {full_scale:g}")
    if flux >= full_scale:
        return LightReading(math.inf, UNIT, READY, over_range=True, flags=("full_scale",))
    return LightReading(flux, UNIT, READY, over_range=False)


class Clock(Protocol):
    """Where time comes from; the `time` module is one."""

    def monotonic(self) -> float:
        """Seconds, never going backwards."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait."""
        ...


class SQ422X:
    """The sensor as a light sensor; satisfies `drivers.kinds.LightSensor`. Others may share its bus.

    `SQ422X.open` makes sure that it is there; the bare constructor sends nothing.

    Parameters
    ----------
    link : ModbusLink
        19200 baud, 8 data bits, even parity, 1 stop bit as delivered. Stays the caller's to close.
    name : str
        For messages.
    address : int
        On the bus, 1 as delivered.
    response_s : float, s
        What it averages over; not verified.
    full_scale : float, umol/(m^2 s)
        A reading from here on is over range; not verified.
    busy_s : float, s
        How long it may be busy; not verified.
    agreement : float
        Share by which two readings in turn may differ; 0 takes one on trust.
    clock
        To wait with while it is busy.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        *,
        address: int = 1,
        response_s: float = 1.0,
        full_scale: float = 4000.0,
        busy_s: float = 2.0,
        agreement: float = 0.05,
        clock: Clock = time,
    ) -> None:
        if not 0 <= agreement < 1:
            raise InvalidSetting(f"agreement {agreement}", device=name, expected="0, or a share below 1")
        for what, value in (("response_s", response_s), ("full_scale", full_scale), ("busy_s", busy_s)):
            if not 0 < value < math.inf:
                raise InvalidSetting(f"{what} {value}", device=name, expected="a finite number above 0")
        self._link = link
        self._unit = ModbusUnit(link, name, address)
        self._response_s, self._full_scale, self._busy_s = response_s, full_scale, busy_s
        self._agreement = agreement
        self._clock = clock
        self._lock = threading.RLock()

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        address: int = 1,
        response_s: float = 1.0,
        full_scale: float = 4000.0,
        busy_s: float = 2.0,
        agreement: float = 0.05,
    ) -> SQ422X:
        """Make sure that a sensor is there which knows its address.

        Raises
        ------
        UnexpectedReply
            Another device, or one that orders the words of a number otherwise.
        """
        sensor = cls(link, name, address=address, response_s=response_s, full_scale=full_scale, busy_s=busy_s, agreement=agreement)
        sensor.identify()
        return sensor

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._unit.name

    @property
    def unit(self) -> str:
        """Always umol/(m^2 s), of photons."""
        return UNIT

    @property
    def integration_s(self) -> float:
        """What the sensor averages over, s."""
        return self._response_s

    def identify(self) -> Identity:
        """Read model, serial number and firmware; the address beside them must be the one that was asked.

        Raises
        ------
        UnexpectedReply
            They are no such numbers.
        """
        attempt, expected = "asking for the identity", f"address {self._unit.address}, model and serial number"
        with self._lock:
            numbers = self._unit.float32(self._unit.holding(ADDRESS, 6, attempt))
            (firmware,) = self._unit.float32(self._unit.holding(FIRMWARE, 2, attempt))
        address, model, serial_number = numbers
        whole = all(math.isfinite(number) and number.is_integer() and number >= 0 for number in numbers)
        if not whole or address != self._unit.address or not (math.isfinite(firmware) and firmware >= 0):
            raise self._unit.unexpected(f"address {address:g}, model {model:g}, serial number {serial_number:g}", attempt, expected)
        return Identity("Apogee", f"SQ-{model:.0f}", f"{serial_number:.0f}", f"{firmware:g}")

    def configure(self, integration_s: float, range: float | None = None) -> None:
        """Check that the sensor's own averaging and range will do; there is nothing to set.

        Raises
        ------
        InvalidSetting
            A longer integration, or a range.
        """
        if not 0 < integration_s <= self._response_s:
            raise InvalidSetting(
                f"integration_s {integration_s}",
                device=self.name,
                expected=f"above 0 and at most {self._response_s:g} s",
                hint="average several readings",
            )
        if range is not None:
            raise InvalidSetting(f"range {range}", device=self.name, expected="none: the sensor has one range only")

    def read(self) -> LightReading:
        """Read the calibrated output once the sensor is not busy, in umol/(m^2 s). A missing or garbled reply is asked for once more.

        The sensor measures all the time, and this is its last measurement: it may have begun ``response_s`` before the call.

        Raises
        ------
        DeviceFault
            It stays busy, has a status that is not known, or tells no number.
        UnexpectedReply
            A flux that the sensor cannot have read, or readings that do not agree.
        """
        attempt = "reading the photon flux"

        def measure() -> LightReading:
            self._wait_until_ready(attempt)
            (value,) = self._unit.float32(self._unit.holding(OUTPUT, 2, attempt))
            return judge(value, self._full_scale)

        try:
            with self._lock:
                return agreed(measure, self._agreement, FLOOR)
        except DeviceError as error:
            error.complete(device=self.name, port=self._link.url, attempt=attempt)
            raise

    def close(self) -> None:
        """Let go of the sensor. The link stays open for the others on it."""
        self._unit.closed = True

    def _wait_until_ready(self, attempt: str) -> None:
        deadline = self._clock.monotonic() + self._busy_s
        while (status := self._status(attempt)) == BUSY:
            if self._clock.monotonic() >= deadline:
                raise self._unit.fault(f"busy for {self._busy_s:g} s", attempt, hint="switch it off and on, or allow more in busy_s")
            self._clock.sleep(POLL_S)
        if status != READY:
            raise self._unit.fault(f"status {status:g}", attempt, expected="0, or 1 while busy")

    def _status(self, attempt: str) -> float:
        (status,) = self._unit.float32(self._unit.holding(STATUS, 2, attempt))
        return status
