"""The virtual bench: kinematics, light, drift and noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.bench import Bench, Lambertian, Lamp, Misalignment, Photodiode, specimen
from sim.clock import ManualClock
from sim.errors import SimError, SpecimenError
from sim.serve import Settings, build

Floats = NDArray[np.float64]
SILENT = Photodiode(dark=0.0, noise_density=0.0)
# Currents are far below the absolute tolerance that pytest.approx has by default, so it is always given here.


class Tilted:
    """A specimen that tells the light's side from the other: f_r = (1 + theta_r/100)/pi."""

    name = "tilted"

    def f_r(self, theta_i: Floats, theta_r: Floats) -> Floats:
        assert np.all(theta_i >= 0)
        return (1 + theta_r / 100) / math.pi + 0 * theta_i


def bench(source: float = 135.0, detector: float = 100.0, **parts: object) -> Bench:
    chosen: dict[str, object] = {"specimen": Lambertian(1.0), "rng": np.random.default_rng(3)} | parts
    return Bench(lambda t: source, lambda t: detector, **chosen)  # type: ignore[arg-type]


def test_a_white_lambertian_at_45_deg_gives_1000_nanoampere() -> None:
    assert bench().light(45.0, 0.0) == pytest.approx(1e-6, rel=1e-12, abs=0)
    assert bench().scale / math.pi * math.cos(math.pi / 4) == pytest.approx(1e-6, rel=1e-12, abs=0)


def test_current_follows_f_r_and_the_cosine_of_incidence_only() -> None:
    world = bench(specimen=Lambertian(0.5))
    assert world.light(60.0, [-80.0, 0.0, 50.0]) == pytest.approx(np.full(3, world.scale * 0.5 / math.pi * 0.5), rel=1e-9, abs=0)
    assert bench(specimen=Tilted()).light(45.0, 20.0) / bench(specimen=Tilted()).light(45.0, -20.0) == pytest.approx(1.2 / 0.8)


def test_light_from_the_other_side_is_the_mirror_image() -> None:
    world = bench(specimen=Tilted())
    assert world.light(-45.0, -20.0) == pytest.approx(float(world.light(45.0, 20.0)), rel=1e-9, abs=0)


@pytest.mark.parametrize(
    ("theta_i", "theta_r", "dark"),
    [
        (45.0, 45.0, True), (45.0, 47.9, True), (45.0, 42.1, True), (45.0, 48.0, False), (45.0, 42.0, False), (-45.0, -44.0, True),
        (90.0, 0.0, True), (89.9, 0.0, False), (-90.0, 0.0, True), (45.0, 90.0, True), (45.0, -90.0, True), (45.0, -89.9, False),
        (120.0, 0.0, True),
    ],
)  # fmt: skip
def test_dark_where_the_arm_blocks_and_behind_the_specimen(theta_i: float, theta_r: float, dark: bool) -> None:
    assert (float(bench().light(theta_i, theta_r)) == 0) == dark


def test_kinematics_from_true_stage_angles() -> None:
    world = bench(source=135.0, detector=60.0, misalignment=Misalignment(0.1, -0.2))
    assert world.angles(0.0) == pytest.approx((45.1, -40.2))
    assert bench(source=0.0, detector=359.0).angles(0.0) == pytest.approx((-90.0, -101.0))


def test_dark_current_remains_when_the_beam_is_blocked() -> None:
    world = bench(source=135.0, detector=145.0, photodiode=Photodiode(dark=3e-12, noise_density=0.0))
    readings = [world.signal(0.0, 1.0) for _ in range(200)]
    assert np.mean(readings) == pytest.approx(3e-12, rel=1e-3, abs=0)


@pytest.mark.parametrize(("detector", "duration"), [(100.0, 0.02), (100.0, 1.0), (145.0, 0.02)])
def test_noise_is_the_shot_noise_of_the_bandwidth_and_the_read_noise(detector: float, duration: float) -> None:
    diode = Photodiode(dark=3e-12, noise_density=1.5e-14)
    world = bench(detector=detector, photodiode=diode)
    readings = np.array([world.signal(0.0, duration) for _ in range(4000)])
    mean = 3e-12 + (1e-6 if detector == 100.0 else 0.0)
    # A mean over T has the bandwidth 1/(2T): variance q I/T of shot noise, n^2/(2T) of the rest.
    variance = 1.602176634e-19 * mean / duration + diode.noise_density**2 / (2 * duration)
    assert np.mean(readings) == pytest.approx(mean, abs=5 * math.sqrt(variance / 4000))
    assert np.var(readings) == pytest.approx(variance, rel=5 * math.sqrt(2 / 3999), abs=0)
    assert abs(np.corrcoef(readings[1:], readings[:-1])[0, 1]) < 5 / math.sqrt(4000)


def test_reading_while_moving_is_the_mean_over_the_way() -> None:
    def detector(t: float) -> float:
        return 100.0 - 60.0 * t

    world = Bench(lambda t: 135.0, detector, Tilted(), np.random.default_rng(1), photodiode=SILENT)
    # f_r is linear in theta_r, so the mean is f_r at the middle, theta_r = -60 * 0.25.
    expected = float(world.light(45.0, -15.0))
    assert world.signal(0.0, 0.5) == pytest.approx(expected, rel=1e-5, abs=0)
    # Half of the way blocked: half of the light. Seen while 24 deg pass, 12 of them on the far side of theta_r = 48.
    passing = Bench(lambda t: 135.0, lambda t: 145.0 + 60.0 * t, Lambertian(1.0), np.random.default_rng(1), photodiode=SILENT)
    assert passing.signal(0.0, 0.1) == pytest.approx(0.5e-6, rel=0.02, abs=0)


@pytest.mark.parametrize("seed", range(10))
def test_the_lamp_drifts_slowly_and_repeatably(seed: int) -> None:
    lamp = Lamp.drawn(np.random.default_rng(seed))
    assert 0.002 <= abs(lamp.trend) <= 0.005
    times = np.arange(0, 3600.0, 1.0)
    level = np.array([lamp.level(t) for t in times])
    wander = level - 1 - lamp.trend * times / 3600
    assert 1e-4 < np.std(wander) < 6e-4
    assert np.max(np.abs(np.diff(level))) < 6e-4  # slow: a reading to the next
    assert lamp.level(1234.5) == lamp.level(1234.5)
    assert abs(level[-1] - 1 - lamp.trend) < 2.5e-3


def test_wander_has_as_much_power_in_each_octave() -> None:
    # 1/f: over all its periods the power is flicker^2, and differences over 1/16 of the slowest period hold most of the fast octaves.
    lamp = Lamp(flicker=3e-4, phases=tuple(np.random.default_rng(0).uniform(0, 6.28, 12)))
    whole = 4.0 * 2**11
    level = np.array([lamp.level(t) for t in np.arange(0, whole, 0.5)])
    assert np.std(level) == pytest.approx(3e-4, rel=1e-3)
    power = np.abs(np.fft.rfft(level - 1))[[2**k for k in range(12)]]
    assert power == pytest.approx(np.full(12, power[0]), rel=1e-6)


def test_seeds_decide_everything() -> None:
    def sample(seed: int) -> tuple[float, ...]:
        world = build(Settings(specimen="lambert:1", seed=seed), ManualClock())
        angles = world.bench.angles(0.0)
        return (*angles, world.bench.misalignment.source, world.meter.offset, world.bench.lamp.trend, world.bench.signal(0.0, 0.02))

    assert sample(4) == sample(4)
    assert all(a != b for a, b in zip(sample(4)[:5], sample(5)[:5], strict=True))


@pytest.mark.parametrize("seed", range(8))
def test_misalignments_are_about_a_tenth_of_a_degree(seed: int) -> None:
    drawn = Misalignment.drawn(np.random.default_rng(seed))
    assert all(0.05 <= abs(angle) <= 0.15 for angle in (drawn.source, drawn.detector))


@pytest.mark.parametrize("text", ["lambert:", "lambert:2", "lambert:x", "lambert:-0.1", "lambert:nan", "mirror:1", "XX", ""])
def test_an_unknown_specimen_is_named(text: str) -> None:
    with pytest.raises(SpecimenError, match="lambert:"):
        specimen(text)


def test_times_must_be_in_order() -> None:
    with pytest.raises(SimError, match="later end"):
        bench().signal(1.0, 1.0)


@pytest.mark.parametrize("name", ["BR", "RR", "PR", "WR"])
def test_petals_lie_on_the_bench(name: str) -> None:
    petal = specimen(name)
    assert petal.name == name
    world = bench(specimen=petal)
    angles = np.array([-70.0, -40.0, 0.0, 40.0, 70.0])
    assert world.light(45.0, angles) == pytest.approx(
        world.scale * petal.f_r(np.full(5, 45.0), angles) * math.cos(math.pi / 4), rel=1e-9, abs=0
    )
    assert world.light(-45.0, -angles) == pytest.approx(world.light(45.0, angles), rel=1e-9, abs=0)
    # Wherever an arm may stand there is some finite light; beyond the table's last incidence, that of the last.
    theta_i, theta_r = np.meshgrid(np.linspace(-179, 179, 60), np.linspace(-179, 179, 61))
    assert np.all(np.isfinite(world.light(theta_i, theta_r)))
    assert petal.f_r(np.array([88.0]), np.array([10.0])) == pytest.approx(petal.f_r(np.array([80.0]), np.array([10.0])), rel=1e-9, abs=0)
