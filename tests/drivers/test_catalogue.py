"""The catalogue: the built-in models, models of other packages, and packages that misbehave."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from drivers import catalogue
from drivers.builtin import BUILT_IN
from drivers.errors import CatalogueError, InvalidSetting, TransportTimeout, UnknownModel
from drivers.models import DeviceModel, Option
from drivers.sensors.keithley6485 import Keithley6485
from drivers.stages.zaber import ZaberAxis

BUILT_IN_NAMES = {"zaber-x-rsw60a", "zaber-x-rst120ak", "keithley-6485"}


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Install packages of one module each, as pip would leave them."""
    monkeypatch.syspath_prepend(str(tmp_path))
    installed: list[str] = []

    def put(package: str, code: str, *entries: str) -> None:
        installed.append(package)
        (tmp_path / f"{package}.py").write_text(code)
        info = tmp_path / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[rig.devices]\n" + "\n".join(entries) + "\n")

    yield put
    for package in installed:
        sys.modules.pop(package, None)


def module(*names: str) -> str:
    """Code of a package with models of these names."""
    made = ", ".join(f"DeviceModel({name!r}, 'light-sensor', 'Acme', 'a lamp eye', 'none', connect=connect)" for name in names)
    return f"from drivers.catalogue import DeviceModel\ndef connect(link, name): return (link, name)\nMODELS = [{made}]\nONE = MODELS[0]\n"


def test_built_in_models() -> None:
    found = catalogue.load()
    assert set(found.models) >= BUILT_IN_NAMES
    assert found.models["zaber-x-rsw60a"].kind == "rotary-axis"
    assert found.models["zaber-x-rsw60a"].line["baudrate"] == 115200
    assert found.models["keithley-6485"].kind == "light-sensor"


@pytest.mark.parametrize("model", BUILT_IN, ids=lambda model: model.name)
def test_every_option_is_described_and_its_default_is_valid(model: DeviceModel) -> None:
    assert model.vendor
    assert model.description
    assert model.protocol
    for option in model.options.values():
        assert option.description
        assert option.check(option.default) == option.default


def test_unknown_models_get_the_list_and_a_guess() -> None:
    with pytest.raises(UnknownModel) as caught:
        catalogue.lookup("zaber-x-rsw60")
    message = str(caught.value)
    assert all(name in message for name in BUILT_IN_NAMES)
    assert "did you mean 'zaber-x-rsw60a'?" in message


def test_models_of_other_packages(install: Any) -> None:
    install("acme_one", module("acme-1"), "one = acme_one:ONE")
    install("acme_many", module("acme-2", "acme-3"), "many = acme_many:MODELS")
    found = catalogue.load()
    assert set(found.models) >= BUILT_IN_NAMES | {"acme-1", "acme-2", "acme-3"}
    assert found.problems == ()
    assert catalogue.lookup("acme-3").vendor == "Acme"


def test_the_same_model_registered_twice_is_no_clash(install: Any) -> None:
    install("acme_twice", module("acme-1"), "a = acme_twice:ONE", "b = acme_twice:MODELS")
    found = catalogue.load()
    assert "acme-1" in found.models
    assert found.problems == ()


@pytest.mark.parametrize(
    ("code", "entry", "complaint"),
    [
        ("raise RuntimeError('no driver library')", "it = acme_bad:MODELS", "RuntimeError: no driver library"),
        ("", "it = acme_bad:MODELS", "AttributeError"),
        ("", "it = acme_nowhere:MODELS", "ModuleNotFoundError"),
        ("MODELS = 7", "it = acme_bad:MODELS", "it holds a int, not a DeviceModel"),
        ("MODELS = ['a']", "it = acme_bad:MODELS", "it holds a str, not a DeviceModel"),
    ],
)
def test_a_broken_package_harms_nobody_else(install: Any, code: str, entry: str, complaint: str) -> None:
    install("acme_bad", code, entry)
    install("acme_good", module("acme-1"), "one = acme_good:ONE")
    found = catalogue.load()
    assert set(found.models) >= BUILT_IN_NAMES | {"acme-1"}
    (problem,) = found.problems
    assert isinstance(problem, CatalogueError)
    assert "acme_bad" in str(problem)
    assert complaint in str(problem)
    with pytest.raises(UnknownModel, match="acme_bad"):
        catalogue.lookup("acme-2")


def test_nobody_takes_a_built_in_name(install: Any) -> None:
    install("acme_thief", module("keithley-6485"), "it = acme_thief:ONE")
    found = catalogue.load()
    assert found.models["keithley-6485"].vendor == "Keithley"
    (problem,) = found.problems
    assert "acme_thief" in str(problem)
    assert "'keithley-6485'" in str(problem)


def test_two_packages_with_one_name_both_lose_it(install: Any) -> None:
    install("acme_a", module("acme-1", "acme-a"), "it = acme_a:MODELS")
    install("acme_b", module("acme-1", "acme-b"), "it = acme_b:MODELS")
    found = catalogue.load()
    assert "acme-1" not in found.models
    assert {"acme-a", "acme-b"} <= set(found.models)
    with pytest.raises(UnknownModel, match="both name a model 'acme-1'"):
        found.lookup("acme-1")


# opening --------------------------------------------------------------------------------------------------------------


def test_opening_a_stage(plug: Any, script: Any) -> None:
    """The peer answers only if address, checksum and scale are as they should be."""
    link = plug(*script.dialogue(b"/3 1 00 get pos\n", b"@03 1 00 OK IDLE -- 100\r\n"))
    model = catalogue.lookup("zaber-x-rst120ak")
    axis = model.open_device(link, name="theta_i", address=3, microsteps_per_degree=10, checksums=False)
    assert isinstance(axis, ZaberAxis)
    assert axis.state().position == 10


def test_opening_a_meter_over_its_own_link(script: Any, make_peer: Any) -> None:
    answer = {b"*IDN?": b"KEITHLEY INSTRUMENTS INC.,MODEL 6485,1,A\n", b"SYST:ERR?": b'0,"No error"\n'}
    lines: list[bytes] = []

    def serve(line: bytes) -> bytes:
        lines.append(line)
        return answer.get(line, b"")

    peer = make_peer(script.serve(2 + 2 * 9 + 2 * 2, serve))
    model = catalogue.lookup("keithley-6485")
    traffic: list[Any] = []
    with model.open_link(peer.url, timeout_s=5, traffic=lambda *entry: traffic.append(entry), baudrate=19200) as link:
        meter = model.open_device(link, name="diode", integration_s=0.5)
        assert isinstance(meter, Keithley6485)
        assert meter.integration_s == 0.5
    assert b"SENS:CURR:NPLC 25.00" in lines
    assert traffic


@pytest.mark.parametrize(
    ("model", "options", "dialogue"),
    [
        ("zaber-x-rsw60a", {"address": 3, "checksums": False}, (b"/3 1 00 stop\n", b"@03 1 00 OK BUSY -- 0\r\n")),
        ("zaber-x-lsm", {"axis": 2, "checksums": False}, (b"/1 2 00 stop\n", b"@01 2 00 OK BUSY -- 0\r\n")),
        ("newport-esp301", {"axis": 2}, (b"2ST;TB?\r", b"0, 1, NO ERROR DETECTED\r\n")),
        ("sigma-koki-shot-302gs", {"axis": 2}, (b"L:2\r\n", b"OK\r\n")),
        ("sigma-koki-gsc-02", {"axis": 2}, (b"L:2\r\nL:2\r\nQ:\r\n", b"         0,         0,K,K,B\r\n")),
    ],
)
def test_halting_sends_the_stop_and_nothing_else(plug: Any, script: Any, model: str, options: dict[str, Any], dialogue: Any) -> None:
    """Strict script: whatever is asked besides would fail it. No scale is needed, nor any other option that does not say where it is."""
    catalogue.lookup(model).halt_device(plug(*script.dialogue(*dialogue)), name="theta_i", **options)


def test_a_model_without_halt_is_opened_and_stopped(plug: Any, script: Any) -> None:
    """As third parties write them."""
    link = plug(*script.dialogue(b"/1 1 00 stop\n", b"@01 1 00 OK BUSY -- 0\r\n"))
    model = DeviceModel(
        "acme-1", "rotary-axis", "Acme", "a table", "Zaber's", connect=partial(ZaberAxis.open, microsteps_per_unit=1.0, checksums=False)
    )
    model.halt_device(link, name="theta_i")


@pytest.mark.parametrize("model", [model for model in BUILT_IN if not model.kind.endswith("-axis")], ids=lambda model: model.name)
def test_only_stages_are_halted(plug: Any, model: DeviceModel) -> None:
    assert model.halt is None
    with pytest.raises(InvalidSetting, match="cannot be stopped"):
        model.halt_device(plug(), name="eye")


def test_only_the_camera_waits_for_somebody() -> None:
    assert [model.name for model in BUILT_IN if not model.reads_at_once] == ["camera-folder"]


def test_opening_an_absent_port() -> None:
    with pytest.raises(TransportTimeout, match="keithley-6485 on /dev/no-such-port"):
        catalogue.lookup("keithley-6485").open_link("/dev/no-such-port")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"adress": 2}, "did you mean 'address'?"),
        ({"address": 2.0}, "option address"),
        ({"address": True}, "option address"),
        ({"address": None}, "option address"),
        ({"checksums": 1}, "option checksums"),
        ({"acceleration_unit": float("nan")}, "option acceleration_unit"),
        ({"microsteps_per_degree": "many"}, "option microsteps_per_degree"),
        ({"speed": 20.0}, "no option 'speed'"),
    ],
)
def test_nonsense_options(plug: Any, options: dict[str, Any], complaint: str) -> None:
    model = catalogue.lookup("zaber-x-rsw60a")
    for call in (model.open_device, model.halt_device):
        with pytest.raises(InvalidSetting) as caught:
            call(plug(), name="theta_i", **options)
        assert complaint in str(caught.value)


@pytest.mark.parametrize("line", [{"baud": 9600}, {"terminator": "XY"}])
def test_nonsense_line_settings(line: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting):
        catalogue.lookup("keithley-6485").open_link("loop://", **line)


def test_whole_numbers_will_do_for_floats() -> None:
    value = Option(float, 1.0, "x").check(3)
    assert value == 3.0
    assert isinstance(value, float)
