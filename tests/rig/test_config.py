import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import load_config, parse_config, template
from rig.errors import ConfigError
from rig.kinematics import AxisMap


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
    "same stage twice": (changed("address = 2", "address = 1"), "axes.detector.address", "same stage"),
    "flag": (changed("crossing = true", "crossing = 1"), "keep_out.crossing", "true or false"),
    "sim port on a real bench": (changed('"/dev/ttyUSB0"', '"sim:stages"'), "axes.source.port", "simulation"),
    "no toml": ("[bench\n", "", "not TOML"),
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
