"""The models that come with the package. Their drivers are imported only when one is opened.

Line settings are those as delivered; where a description says "not verified", documents alone stand behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from drivers.kinds import LightSensor
from drivers.link import Link
from drivers.models import Device, DeviceModel, Option


def _driver(path: str, **fixed: Any) -> Callable[..., Device]:
    """Make the `connect` of a model out of a driver's ``module:Class`` and what is fixed about it; options left open are left out."""

    def connect(link: Link, name: str, **options: Any) -> Device:
        given = {key: value for key, value in options.items() if value is not None}
        device: Device = _load(path).open(link, name, **fixed, **given)
        return device

    return connect


def _halt(path: str, *place: str, **fixed: Any) -> Callable[..., None]:
    """Make the `halt` of a model out of a driver's ``module:Class``: the bare constructor, which sends nothing, and a stop.

    Of the options only those of `place`, which say where the stage is, are the constructor's business.
    """

    def halt(link: Link, name: str, **options: Any) -> None:
        _load(path)(link, name, **fixed, **{key: options[key] for key in place}).stop()

    return halt


def _port(path: str) -> Callable[..., Link]:
    """Make the `open_port` of a model out of a link's ``module:Class``."""

    def open_port(url: str, **settings: Any) -> Link:
        link: Link = _load(path).open(url, **settings)
        return link

    return open_port


def _load(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def _line(baudrate: int, frame: str = "8N1", **more: Any) -> dict[str, Any]:
    return {"baudrate": baudrate, "bytesize": int(frame[0]), "parity": frame[1], "stopbits": int(frame[2]), **more}


_MODBUS = _port("drivers.modbus:ModbusLink")


def _zaber(name: str, description: str) -> DeviceModel:
    linear = name.startswith("zaber-x-l")
    unit = "mm" if linear else "deg"
    scale = f"microsteps_per_{'mm' if linear else 'degree'}"
    told = "1000 over the microstep size in um of the data sheet" if linear else "read from the stage when not given"

    def connect(link: Link, name: str, **options: Any) -> Device:
        opened = _driver("drivers.stages.zaber:ZaberAxis", unit=unit)
        return opened(link, name, microsteps_per_unit=options.pop(scale), **options)

    return DeviceModel(
        name=name,
        kind="linear-axis" if linear else "rotary-axis",
        vendor="Zaber",
        description=description,
        protocol="Zaber ASCII",
        connect=connect,
        halt=_halt("drivers.stages.zaber:ZaberAxis", "address", "axis", "checksums", microsteps_per_unit=1.0),
        line=_line(115200, terminator="CRLF"),
        options={
            "address": Option(int, 1, "device address on the chain"),
            "axis": Option(int, 1, "axis of the device"),
            scale: Option(float, None, f"scale; {told}"),
            "acceleration_unit": Option(float, None, "microsteps/s^2 in one unit of accel; default 10000/1.6384, not verified"),
            "checksums": Option(bool, True, "send checksums and insist on them in replies"),
        },
    )


def _newport(name: str, description: str, baudrate: int) -> DeviceModel:
    return DeviceModel(
        name=name,
        kind="rotary-axis",
        vendor="Newport",
        description=description,
        protocol="Newport ESP over RS-232",
        connect=_driver("drivers.stages.newport:NewportAxis"),
        halt=_halt("drivers.stages.newport:NewportAxis", "axis"),
        line=_line(baudrate, rtscts=True, terminator="CRLF"),
        options={
            "axis": Option(int, 1, "axis of the controller, 1 to 3"),
            "degrees_per_unit": Option(float, None, "scale; found from the units the axis is set to when not given"),
            "home_search": Option(int, 1, "parameter of OR: 1 home and index, 2 home, 3 to 6 limit switches; not verified"),
        },
    )


def _sigma_koki(name: str, controller: str, description: str) -> DeviceModel:
    options = {
        "axis": Option(int, 1, "axis of the controller, 1 or 2"),
        "degrees_per_pulse": Option(float, None, "scale; from the division of steps when not given, 0.0025 deg where it is not told"),
        "low_deg": Option(float, -180.0, "lower end of travel in deg: the controller knows none"),
        "high_deg": Option(float, 180.0, "upper end of travel in deg"),
    }
    if controller == "GSC-02":
        options["home_direction"] = Option(str, "-", "+ or -: where to look for the origin")
    return DeviceModel(
        name=name,
        kind="rotary-axis",
        vendor="Sigma Koki",
        description=description,
        protocol="Sigma Koki ASCII over RS-232",
        connect=_driver("drivers.stages.sigma_koki:SigmaKokiAxis", controller=controller),
        halt=_halt("drivers.stages.sigma_koki:SigmaKokiAxis", "axis", controller=controller),
        line=_line(9600, rtscts=True, terminator="CRLF"),
        options=options,
    )


def _minolta(name: str, model: str, description: str) -> DeviceModel:
    options = {
        "integration_s": Option(float, 0.4, "at least so long in s; chooses the fast or the slow response"),
        "calibration": Option(str, "preset", "preset or varied"),
        "serial_number": Option(str, "not told", "for the record: the meter does not tell it"),
        "fast_s": Option(float, 0.1, "integration time of the fast response in s; not verified"),
        "slow_s": Option(float, 0.4, "integration time of the slow response in s; not verified"),
        "measuring_s": Option(float, 3.0, "time allowed for a measurement in s; not verified"),
        "fixed_width": Option(bool, True, "insist on the width of a reading's fields, so that a lost digit shows; not verified"),
        "agreement": Option(float, 0.05, "share by which two readings in turn may differ; 0 takes one on trust"),
    }
    if model == "CS-100A":
        options["chroma_over_is_good"] = Option(bool, False, "trust the luminance when the chromaticity is out of range; not verified")
    return DeviceModel(
        name=name,
        kind="light-sensor",
        vendor="Konica Minolta",
        description=description,
        protocol="Konica Minolta ASCII over RS-232",
        connect=_driver("drivers.sensors.konica_minolta:LuminanceMeter", model=model),
        line=_line(4800, "7E2", terminator="CRLF"),
        options=options,
    )


def _connect_keithley(link: Link, name: str, *, overflow_bit: int, zero_check_bit: int, **options: Any) -> LightSensor:
    from drivers.sensors.keithley6485 import Keithley6485, StatusBits

    return Keithley6485.open(link, name, status_bits=StatusBits(overflow=overflow_bit, zero_check=zero_check_bit), **options)


def _connect_baumer(link: Link, name: str, *, dropout_ms: int, **options: Any) -> Device:
    from drivers.rangefinders.baumer_om import BaumerOM

    return BaumerOM.open(link, name, dropout_ms=None if dropout_ms < 0 else dropout_ms, **options)


def _baumer(name: str, description: str) -> DeviceModel:
    return DeviceModel(
        name=name,
        kind="range-finder",
        vendor="Baumer",
        description=description,
        protocol="Modbus RTU",
        connect=_connect_baumer,
        open_port=_MODBUS,
        line=_line(57600, "8E1"),
        options={
            "address": Option(int, 1, "address on the bus"),
            "weak_is_good": Option(bool, False, "trust a distance measured with a weak signal; not verified"),
            "fresh_s": Option(float, 1.0, "time allowed for a new measurement in s"),
            "dropout_ms": Option(int, 0, "for how long a lost target's distance is told in ms; -1 to leave the sensor's own"),
        },
    )


BUILT_IN: tuple[DeviceModel, ...] = (
    _zaber("zaber-x-rsw60a", "motorised rotary stage, 60 mm"),
    # Only its existence is known: its step size is read from the stage like the other's.
    _zaber("zaber-x-rst120ak", "motorised rotary stage, 120 mm"),
    _zaber("zaber-x-lsm", "motorised linear stage"),
    # 921600 baud is that of the ESP301's own USB port; its RS-232 port has 19200 as the ESP300's. Not verified.
    _newport("newport-esp301", "motion controller with a rotary stage", 921600),
    _newport("newport-esp300", "motion controller with a rotary stage", 19200),
    _sigma_koki("sigma-koki-shot-302gs", "SHOT-302GS", "stage controller with a rotary stage, such as OSMS-60YAW"),
    _sigma_koki("sigma-koki-gsc-02", "GSC-02", "stage controller with a rotary stage; it answers no command"),
    DeviceModel(
        name="oriental-az",
        kind="rotary-axis",
        vendor="Oriental Motor",
        description="AZ driver with hollow rotary actuator (DGII)",
        protocol="Modbus RTU",
        connect=_driver("drivers.stages.oriental:OrientalAxis"),
        halt=_halt("drivers.stages.oriental:OrientalAxis", "address"),
        open_port=_MODBUS,
        line=_line(115200, "8E1"),
        options={
            "address": Option(int, 1, "address set on the rotary switch"),
            "steps_per_degree": Option(float, 50.0, "scale; default for 1000 steps a turn and an 18:1 gear, not verified"),
            "limit_min_deg": Option(float, 0.0, "lower end of travel in deg; set the same in the driver"),
            "limit_max_deg": Option(float, 360.0, "upper end of travel in deg; set the same in the driver"),
            "home_bit": Option(int, 4, "input bit that starts homing, 0 to 15; as delivered ZHOME"),
            "home_end_holds": Option(bool, True, "whether HOME-END stays on when the axis moves on; not verified"),
        },
    ),
    DeviceModel(
        name="keithley-6485",
        kind="light-sensor",
        vendor="Keithley",
        description="picoammeter reading a photodiode, 2 nA to 20 mA",
        protocol="SCPI over RS-232",
        connect=_connect_keithley,
        # Baud rate and terminator are set in the meter's menu; as delivered not verified.
        line=_line(9600, xonxoff=False, terminator="LF"),
        options={
            "integration_s": Option(float, 0.1, "integration time in s, up to 1"),
            "range": Option(float, None, "full scale in A; automatic when not given"),
            "line_frequency_hz": Option(int, 50, "mains frequency, 50 or 60 Hz"),
            "overflow_bit": Option(int, 0, "status bit that means overflow, -1 to ignore; not verified"),
            "zero_check_bit": Option(int, 9, "status bit that means zero check on, -1 to ignore; not verified"),
        },
    ),
    _minolta("konica-minolta-ls-100", "LS-100", "luminance meter, cd/m^2"),
    _minolta("konica-minolta-ls-110", "LS-110", "luminance meter, cd/m^2"),
    _minolta("konica-minolta-cs-100a", "CS-100A", "colour luminance meter, cd/m^2"),
    DeviceModel(
        name="apogee-sq-422x",
        kind="light-sensor",
        vendor="Apogee",
        description="quantum sensor, to monitor the lamp, umol/(m^2 s)",
        protocol="Modbus RTU",
        connect=_driver("drivers.sensors.apogee:SQ422X"),
        open_port=_MODBUS,
        line=_line(19200, "8E1"),
        options={
            "address": Option(int, 1, "address on the bus"),
            "response_s": Option(float, 1.0, "what the sensor averages over in s; not verified"),
            "full_scale": Option(float, 4000.0, "over range from here on, umol/(m^2 s); not verified"),
            "busy_s": Option(float, 2.0, "how long it may be busy in s; not verified"),
            "agreement": Option(float, 0.05, "share by which two readings in turn may differ; 0 takes one on trust"),
        },
    ),
    DeviceModel(
        name="camera-folder",
        kind="light-sensor",
        vendor="any",
        description="tethered camera whose RAW files fall into a folder, 1/s",
        protocol="RAW files in a folder, its port is folder:PATH",
        connect=_driver("drivers.cameras.folder:FolderCamera"),
        open_port=_port("drivers.cameras.folder:FolderLink"),
        reads_at_once=False,  # somebody may have to press the shutter
        options={
            "patch": Option(str, "markers", "markers, markers:A,B,C,D (top left, clockwise), chart:NUMBER or X,Y,WIDTH,HEIGHT"),
            "dictionary": Option(str, "DICT_4X4_50", "OpenCV's name of the markers' dictionary"),
            "margin": Option(float, 0.2, "how far the patch's corners stand back, as a fraction of the way to its middle"),
            "channel": Option(str, "G", "R, G or B"),
            "integration_s": Option(float, 1e-4, "a shorter exposure in s is refused; the exposure is set at the camera"),
            "saturated_fraction": Option(float, 0.0, "of the patch's pixels that may be saturated in a good reading"),
            "iso": Option(float, None, "for files that do not tell"),
            "pattern": Option(str, "*", "names of the files that count"),
            "patience_s": Option(float, 60.0, "how long to wait for a picture in s"),
            "settle_s": Option(float, 0.2, "how long a file must have rested before it is read in s"),
            "trigger_command": Option(str, None, "takes a picture, run in the folder without a shell; none: somebody presses the shutter"),
            "trigger_s": Option(float, 60.0, "time allowed for it in s"),
        },
    ),
    _baumer("baumer-om20", "laser distance sensor, small"),
    _baumer("baumer-om30", "laser distance sensor"),
    DeviceModel(
        name="micro-epsilon-ild1420",
        kind="range-finder",
        vendor="Micro-Epsilon",
        description="optoNCDT 1420 laser triangulation sensor, 10 to 500 mm",
        protocol="ASCII commands and binary stream over RS-422",
        connect=_driver("drivers.rangefinders.optoncdt1420:OptoNCDT1420"),
        open_port=_port("drivers.rangefinders.optoncdt1420:StreamLink"),
        line=_line(921600),
        options={
            "measuring_rate_khz": Option(float, 1.0, "measuring rate in kHz"),
            "measuring_range_mm": Option(float, None, "as printed on the sensor; asked from it when not given"),
            "values": Option(int, 5, "values a reading is the median of"),
            "spread_mm": Option(float, None, "values that differ by more make a reading doubtful; 1 % of the range when not given"),
            "start_of_range_mm": Option(float, 0.0, "from the sensor's front to the start of its range, added to all distances"),
            "last_valid": Option(int, 64877, "last word within the range; not verified, another source has 64887"),
        },
    ),
)
