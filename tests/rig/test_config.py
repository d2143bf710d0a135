import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import load_config, parse_config, template
from rig.errors import ConfigError, InterlockError
from rig.kinematics import AxisMap
from rig.measuring import new_order, travel_estimate_s
from rig.trajectory import Trajectory


def test_the_template_is_a_valid_bench() -> None:
    config = parse_config(template(), "rig.toml")
    assert not config.simulated
    assert config.axes["detector"].limits == (-85.0, 85.0)
    assert config.axes["detector"].options == {"address": 2}
    assert config.sensor.options == {"line_frequency_hz": 50}


def test_without_a_file_the_bench_is_simulated(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_config(None).simulated


def changed(old: str, new: str) -> str:
    text = template()
    assert old in text
    return text.replace(old, new, 1)


LAMP = """
[sensors.lamp]
model = "apogee-sq-422x"
port = "/dev/ttyUSB2"
monitor = true
"""

SLIDE = """
[axes.x]
model = "zaber-x-lsm"
port = "/dev/ttyUSB3"
microsteps_per_mm = 20997.375
limits = [0.0, 150.0]
"""

FINDER = """
[sensors.distance]
model = "baumer-om20"
port = "/dev/ttyUSB4"
"""

ESP = """
[axes.tilt]
model = "newport-esp301"
port = "/dev/ttyUSB5"
limits = [-10.0, 10.0]
"""


def extended(*more: str) -> str:
    return template().replace("[keep_out]", "".join(more) + "[keep_out]", 1)


BAD = {
    "unknown model": (changed('"zaber-x-rsw60a"', '"zaber-x-rsw60"'), "axes.source.model", "zaber-x-rsw60a"),
    "a sensor as an axis": (changed('"zaber-x-rsw60a"', '"keithley-6485"'), "axes.source.model", "zaber-x-rsw60a"),
    "missing port": (changed('port = "/dev/ttyUSB0"', ""), "axes.source.port", "missing"),
    "limits swapped": (changed("limits = [0.0, 80.0]", "limits = [80.0, 0.0]"), "axes.source.limits", "swapped"),
    "limits of one": (changed("limits = [0.0, 80.0]", "limits = [80.0]"), "axes.source.limits", "lowest, highest"),
    "sign": (changed("sign = 1", "sign = 2"), "axes.source.sign", "1 or -1"),
    "speed": (changed("speed = 60.0", "speed = 0"), "axes.source.speed", "above 0"),
    "nan": (changed("offset = 90.0", "offset = nan"), "axes.source.offset", "number"),
    "text for a number": (changed("settle = 0.1", 'settle = "0.1"'), "axes.source.settle", "number"),
    "unknown key": (changed("settle = 0.1", "setle = 0.1"), "axes.source.setle", "settle"),
    "unknown table": (template() + "\n[lamp]\n", "lamp", "keep_out"),
    "missing table": (template().split("[keep_out]")[0], "keep_out", "missing"),
    "option's type": (changed("address = 1", 'address = "1"'), "axes.source.address", "int"),
    "same stage twice": (changed("address = 2", "address = 1"), "axes.detector.address", "same instrument"),
    "flag": (changed("crossing = true", "crossing = 1"), "keep_out.crossing", "true or false"),
    "sim port on a real bench": (changed('"/dev/ttyUSB0"', '"sim:stages"'), "axes.source.port", "simulation"),
    "no toml": ("[bench\n", "", "not TOML"),
    "an arm that is linear": (changed('"zaber-x-rsw60a"', '"zaber-x-lsm"'), "axes.source.model", "unknown model 'zaber-x-lsm'"),
    "a range finder to sweep with": (changed('"keithley-6485"', '"baumer-om20"'), "sensor.model", "a light-sensor may be"),
    "the main sensor as a monitor": (changed("integration = 0.1", "monitor = true"), "sensor.monitor", "unknown key"),
    "the main sensor again": (changed("[keep_out]", LAMP.replace("lamp", "sensor") + "[keep_out]"), "sensors.sensor", "taken"),
    "a sensor called as an axis": (changed("[keep_out]", LAMP.replace("lamp", "detector") + "[keep_out]"), "sensors.detector", "taken"),
    "a name with a dash": (changed("[keep_out]", LAMP.replace("lamp", "my-lamp") + "[keep_out]"), "sensors.my-lamp", "small letters"),
    "an axis with a capital": (changed("[keep_out]", SLIDE.replace("axes.x", "axes.X") + "[keep_out]"), "axes.X", "small letters"),
    "a sensor that is no table": (changed("[keep_out]", "[sensors]\nlamp = 1\n[keep_out]"), "sensors.lamp", "expected a table"),
    "a range finder that monitors": (
        changed("[keep_out]", FINDER + "monitor = true\n[keep_out]"),
        "sensors.distance.monitor",
        "unknown key",
    ),
    "a range finder that integrates": (
        changed("[keep_out]", FINDER + "integration = 1.0\n[keep_out]"),
        "sensors.distance.integration",
        "unknown key",
    ),
    "a stage as a sensor": (
        changed("[keep_out]", LAMP.replace("apogee-sq-422x", "zaber-x-lsm") + "[keep_out]"),
        "sensors.lamp.model",
        "range-finder",
    ),
    "a monitor as text": (changed("[keep_out]", LAMP.replace("true", '"yes"') + "[keep_out]"), "sensors.lamp.monitor", "true or false"),
    "mm beyond reason": (changed("[keep_out]", SLIDE.replace("150.0]", "20000.0]") + "[keep_out]"), "axes.x.limits", "in mm"),
    "shadow": (changed("[keep_out]", "[keep_out]\nshadow = 91.0"), "keep_out.shadow", "from 0 to 90"),
    "another protocol on the same port": (
        changed("[keep_out]", LAMP.replace("/dev/ttyUSB2", "/dev/ttyUSB1") + "[keep_out]"),
        "sensors.lamp.port",
        "'/dev/ttyUSB1' is the port of sensor, whose line settings or protocol are others",
    ),
    "other line settings on the same port": (
        changed("[keep_out]", SLIDE.replace("/dev/ttyUSB3", "/dev/ttyUSB0").replace("limits", "baudrate = 9600\nlimits") + "[keep_out]"),
        "axes.x.port",
        "'/dev/ttyUSB0' is the port of axes.source, whose line settings",
    ),
    "other speeds of one bus": (
        changed("[keep_out]", LAMP + FINDER.replace("/dev/ttyUSB4", "/dev/ttyUSB2") + "[keep_out]"),
        "sensors.distance.port",
        "'/dev/ttyUSB2' is the port of sensors.lamp",
    ),
    "the same controller's axis twice": (
        changed("[keep_out]", ESP + ESP.replace("axes.tilt", "axes.tip") + "[keep_out]"),
        "axes.tip.axis",
        "the same instrument as axes.tilt",
    ),
    "the same stage by default": (
        changed("[keep_out]", SLIDE.replace("/dev/ttyUSB3", "/dev/ttyUSB0") + "[keep_out]"),
        "axes.x.address",
        "the same instrument as axes.source",
    ),
    "two models at one address": (
        changed("[keep_out]", LAMP + FINDER.replace("/dev/ttyUSB4", "/dev/ttyUSB2") + "baudrate = 19200\n[keep_out]"),
        "sensors.distance.address",
        "the same instrument as sensors.lamp",
    ),
    "sim port on a served bench": (
        changed("[bench]", "[simulation]\nserved = true\n[bench]").replace("/dev/ttyUSB0", "sim:stages"),
        "axes.source.port",
        "not served",
    ),
    "real port on a simulated bench": (changed("[bench]", "[simulation]\n[bench]"), "axes.source.port", "sim:NAME"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_configurations_name_the_key_in_one_line(case: str) -> None:
    text, key, says = BAD[case]
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "rig.toml")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"rig.toml: {key}")
    assert says in message


@given(st.sampled_from([1, -1]), st.floats(-360, 360), st.floats(-180, 180))
def test_theta_and_axis_are_each_others_inverse(sign: int, offset: float, theta: float) -> None:
    axis_map = AxisMap(sign, offset)
    assert axis_map.to_theta(axis_map.to_axis(theta)) == pytest.approx(theta, abs=1e-9)


def test_a_stage_that_counts_backwards() -> None:
    assert AxisMap(-1, 90.0).to_axis(30.0) == 60.0


# More than two arms and a meter


def test_further_axes_and_sensors() -> None:
    config = parse_config(extended(LAMP, SLIDE, FINDER, ESP), "rig.toml")
    assert list(config.axes) == ["source", "detector", "x", "tilt"]
    assert [axis.unit for axis in config.axes.values()] == ["deg", "deg", "mm", "deg"]
    assert config.axes["x"].limits == (0.0, 150.0)
    assert config.axes["x"].options == {"microsteps_per_mm": 20997.375}
    assert list(config.sensors) == ["sensor", "lamp", "distance"]
    lamp, distance = config.sensors["lamp"], config.sensors["distance"]
    assert (lamp.monitor, distance.monitor, config.sensor.monitor) == (True, False, False)
    assert lamp.integration_s is not None
    assert (distance.integration_s, distance.range) == (None, None)
    assert list(config.devices) == [*config.axes, *config.sensors]
    assert config.interlock.limits["x"] == (0.0, 150.0)
    assert config.interlock.units["x"] == "mm"


def test_what_speaks_alike_may_share_a_port() -> None:
    second = FINDER.replace("distance", "height").replace('"baumer-om20"', '"baumer-om30"\naddress = 2')
    config = parse_config(
        extended(FINDER, second, SLIDE.replace("/dev/ttyUSB3", "/dev/ttyUSB0").replace("limits", "address = 3\nlimits")), "rig.toml"
    )
    assert config.sensors["distance"].port == config.sensors["height"].port
    assert config.axes["x"].port == config.axes["source"].port
    alike = FINDER.replace("/dev/ttyUSB4", "/dev/ttyUSB2") + "address = 2\nbaudrate = 19200\n"
    config = parse_config(extended(LAMP, alike), "rig.toml")
    assert config.sensors["distance"].port == config.sensors["lamp"].port


def test_an_axis_is_known_by_its_place_not_by_its_name() -> None:
    axes = parse_config(extended(SLIDE, ESP), "rig.toml").axes
    assert len({axis.identity for axis in axes.values()}) == 4
    renamed = parse_config(extended(SLIDE.replace("axes.x", "axes.y")), "rig.toml").axes["y"]
    assert renamed.identity == axes["x"].identity
    assert axes["detector"].identity == "/dev/ttyUSB0 zaber-x-rsw60a address=2 axis=1"


def test_the_shadow_is_as_wide_as_the_keep_out_unless_told() -> None:
    assert parse_config(template(), "rig.toml").keep_out.shadow_deg == 3.0
    config = parse_config(template().replace("[keep_out]", "[keep_out]\nshadow = 8.0", 1), "rig.toml")
    assert (config.keep_out.within_deg, config.keep_out.shadow_deg) == (3.0, 8.0)
    position = {"source": 45.0, "detector": 40.0}
    config.interlock.check_position(position)
    with pytest.raises(InterlockError, match="blocks the light"):
        config.interlock.check_reading(position)


def test_a_simulation_that_is_served_has_ports() -> None:
    config = parse_config(template().replace("[bench]", "[simulation]\nspeed = 5.0\nserved = true\n[bench]", 1), "rig.toml")
    assert config.simulated
    assert config.simulation is not None
    assert dataclasses.astuple(config.simulation) == (5.0, None, True)


def test_a_sweep_over_more_axes_is_estimated_by_its_arms() -> None:
    plain, more = (
        new_order(parse_config(text, "rig.toml"), "RR", Trajectory((45.0,), (-20.0, 0.0, 20.0))) for text in (template(), extended(SLIDE))
    )
    assert travel_estimate_s(more) == travel_estimate_s(plain) > 0


def test_a_sweep_with_a_point_in_the_shadow_is_refused() -> None:
    config = parse_config(template().replace("[keep_out]", "[keep_out]\nshadow = 8.0", 1), "rig.toml")
    new_order(config, "RR", Trajectory((45.0,), (37.0,)))
    with pytest.raises(InterlockError, match="blocks the light"):
        new_order(config, "RR", Trajectory((45.0,), (40.0,)))
