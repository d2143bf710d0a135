"""The controllers as seen by other people's clients: pyOptoSigma, SigmaKokiPy and PySigmaKoki, each installed or skipped by itself."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from sim.clock import SimClock
from sim.sigma_koki import GSC_02, SHOT_302GS, Kind, SigmaKoki
from tests.sim.served import Ports, served

Start = Callable[[Kind], tuple[SigmaKoki, Ports]]


def client(module: str) -> Any:
    """Import a client, or skip for want of it; they are old and say so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip(module, reason=f"{module.partition('.')[0]} is not installed")


@pytest.fixture
def start(quiet: None) -> Iterator[Start]:
    with ExitStack() as stack:
        yield lambda kind: stack.enter_context(served(lambda: SigmaKoki(SimClock(40.0), [100.0, 30.0], kind)))


def test_pyoptosigma_homes_moves_and_reads_back(start: Start) -> None:
    optosigma = client("pyOptoSigma")
    sigma, ports = start(SHOT_302GS)
    session = optosigma.Session(optosigma.Controllers.SHOT_302GS, wait_time=0.01)
    for _ in range(2):
        session.append_stage(optosigma.Stages.SGSP_60YAW)
    session.connect(ports.pty)
    try:
        session.initialize()
        assert session.get_position(in_pulse=True) == [0, 0]
        session.set_speed(stage=1, S=100, F=10000, R=100)
        assert sigma.axes[0].speeds == (100, 10000, 100)
        session.move(stage=1, amount=45000, absolute=True)  # millidegrees
        assert session.get_position(in_pulse=True) == [18000, 0]
        session.move(amount=(-15000, 10000))
        assert session.get_position(in_pulse=True) == [12000, 4000]
        assert sigma.axes[0].track.nominal(sigma._clock.now())[0] == pytest.approx(30.0)
        session.jog(stage=2, directions=-1)
        assert session.is_busy()
        with pytest.raises(optosigma.Bad_Command_Parameter_or_Timing):
            session.set_origin(stage=1)
        session.stop(stage=2)
        assert session.is_ready()
        session.set_origin(all_stages=True)
        assert session.get_position(in_pulse=True) == [0, 0]
        session.set_division(stage=1, division=10)
        assert session.divisions == [10, 2]
        with pytest.raises(optosigma.Bad_Command_Parameter_or_Timing):
            session.move(stage=1, amount=300_000_000, in_pulse=True)
    finally:
        session.port.close()


def test_sigmakokipy_homes_moves_and_reads_the_fixed_columns(start: Start) -> None:
    shot = client("SigmaKokiPy.SK_SHOT")
    sigma, ports = start(SHOT_302GS)
    control = shot.StageControlShot(ports.pty, "SHOT-702 / SHOT-302GS", 9600)
    try:

        def settle() -> None:
            assert control.UpdateStatus()
            while control.IsBusy:
                assert control.UpdateStatus()

        assert control.ReturnMechanicalOriginAll()
        settle()
        assert [control.GetPositionPulse(axis) for axis in (1, 2)] == [0, 0]
        assert control.SetSpeedSinglePulse(1, 10000, 100)
        assert sigma.axes[0].speeds == (5000, 10000, 100)
        assert control.GenericCommand("A:1-P4000") is not False
        assert control.GenericCommand("G:") is not False
        settle()
        assert control.GetPositionPulse(1) == -4000
        assert control.EmergencyStop()
    finally:
        control.CloseSerialPort()


def test_pysigmakoki_drives_a_gsc_02_that_answers_nothing(start: Start) -> None:
    koki = client("sigma_koki")
    sigma, ports = start(GSC_02)
    gsc = koki.GSC02()
    gsc.open(ports.pty)
    try:

        def settle() -> None:
            while gsc.getACK3() == "B":
                pass

        gsc.returnToMechanicalOrigin("+", "-")
        settle()
        assert gsc.getStatus() == "         0,         0,K,K,R"
        gsc.setSpeed(True, 100, 10000, 100, 100, 5000, 200)
        assert gsc.getStatus() == "         0,         0,K,K,R"
        assert [axis.speeds for axis in sigma.axes] == [(100, 10000, 100), (100, 5000, 200)]
        gsc.move_absolute(4000, -8000)
        assert gsc.getACK3() == "B"
        settle()
        assert gsc.getStatus() == "      4000,-     8000,K,K,R"
        gsc.jog("+", "")
        gsc.decelerate(True, False)
        settle()
        gsc.initializeOrigin(True, True)
        assert gsc.getStatus() == "         0,         0,K,K,R"
        gsc.enableMotorExcitation(False, False)
        gsc.move_relative(1, 1)
        assert gsc.getStatus() == "         0,         0,X,K,R"
        assert gsc.getVersion() == "V1.00"
    finally:
        gsc.close()
