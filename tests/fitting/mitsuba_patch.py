"""A patch of many domes as triangles, and Mitsuba 3 to trace it: the same sums as `fitting`, by code that shares nothing with it.

A tile is one dome and the floor of its hexagon; the patch is a disc of tiles. What is measured starts within one period in the middle, so
its edge does not matter where the patch reaches far enough. Angles follow the house's convention (deg, phi = 0 on the light's side).

Every estimate is made in strata of the lattice's azimuth, twice in each: the difference of the two gives its standard error.
"""

from __future__ import annotations

import ctypes.util
import functools
import glob
import math
import os
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitting.cells import Cell

Array = NDArray[np.float64]
Direction = tuple[float, float, float]
"""theta_i, theta_r, phi, deg."""

SURE = 4.0
"""Standard errors by which an estimate may be off."""


class Estimate(NamedTuple):
    """Means and their standard errors."""

    mean: Array
    error: Array

    @classmethod
    def of_pairs(cls, values: Array) -> Estimate:
        """From values of shape (strata, 2, ...), the two of a stratum drawn alike."""
        error = np.sqrt(((values[:, 0] - values[:, 1]) ** 2).sum(0)) / (2 * len(values))
        return cls(values.mean((0, 1)), error)

    def check(self, model: Array | float, relative: float, what: str, absolute: Array | float = 0.0) -> None:
        """Raise AssertionError where the model is further off than `SURE` standard errors and an allowance for the triangles."""
        off = np.abs(self.mean - model)
        allowed = SURE * self.error + relative * np.abs(self.mean) + absolute
        assert np.all(off <= allowed), f"{what}: Mitsuba {self.mean} with standard errors {self.error}, the model {model}"


def llvm_library() -> str | None:
    """Newest shared LLVM that Dr.Jit can use (16 or later; Debian's 14 and 15 fail), None where there is none."""
    if path := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return path
    places = ("/usr/lib*", "/usr/lib/*-linux-gnu*", "/usr/lib/llvm-*/lib", "/usr/local/lib", "/opt/homebrew/opt/llvm*/lib")
    found = [
        path for place in places for name in ("libLLVM-*.so", "libLLVM.so.*", "libLLVM.dylib") for path in glob.glob(f"{place}/{name}")
    ]
    by_version = {int(m[1]): path for path in found if (m := re.search(r"LLVM[-.](?:so\.)?(\d+)", path)) and int(m[1]) >= 16}
    if by_version:
        return by_version[max(by_version)]
    return next((path for path in found if path.endswith(".dylib")), None) or ctypes.util.find_library("LLVM")


@functools.cache
def mitsuba() -> Any:
    """Mitsuba 3 in its LLVM variant where there is an LLVM, else scalar: about three times slower in a render, far slower ray by ray."""
    import mitsuba as mi

    if library := llvm_library():
        os.environ["DRJIT_LIBLLVM_PATH"] = library
        try:
            mi.set_variant("llvm_ad_rgb")
            float(mi.Float([1.0, 2.0])[1])
            return mi
        except Exception as error:  # what Dr.Jit raises where its library is of no use differs
            print(f"no LLVM for Mitsuba: {error}")
    mi.set_variant("scalar_rgb")
    return mi


def vectorised() -> bool:
    """Whether Mitsuba traces arrays of rays."""
    return str(mitsuba().variant()).startswith("llvm")


def towards(theta: float, azimuth: float) -> Array:
    """Unit vector, from angles in deg."""
    t, a = math.radians(theta), math.radians(azimuth)
    return np.array([math.sin(t) * math.cos(a), math.sin(t) * math.sin(a), math.cos(t)])


def azimuths(strata: int, seed: int) -> Array:
    """Azimuths of the lattice (deg), shape (strata, 2): each sixth of a turn is like the others."""
    return np.asarray((np.arange(strata)[:, None] + np.random.default_rng(seed).random((strata, 2))) * 60 / strata)


class Tile:
    """Triangles of a dome and of the floor in its hexagon.

    Parameters
    ----------
    cell : Cell
        Only its numbers are used.
    rings, around : int
        Of quadrilaterals on the dome; around a multiple of 12, so that the hexagon's corners and sides have their vertices.

    Attributes
    ----------
    vertices : ndarray, shape (v, 3), a
    triangles : ndarray, shape (t, 3)
        The dome's first, then the floor's.
    normals : ndarray, shape (v, 3)
        Of the smooth dome; the floor's are (0, 0, 1).
    dome : int
        Number of triangles of the dome.
    """

    def __init__(self, cell: Cell, rings: int, around: int) -> None:
        self.height, self.pitch = 2 * cell.aspect, 2 * (1 + cell.gap)
        fine = np.linspace(0, np.pi / 2, 20_001)
        r, z = np.sin(fine) ** (2 / cell.p), self.height * np.cos(fine) ** (2 / cell.q)
        z[-1] = 0.0
        tilt = np.maximum.accumulate(np.concatenate([[0.0], np.arctan2(-np.diff(z), np.diff(r))]))
        length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(r), np.diff(z)))])
        # Rings half even along the profile and half even over its tilt: neither the wall nor the tip is coarse.
        even = length / length[-1] + tilt / tilt[-1]
        k = np.searchsorted(even, np.linspace(0, 2, rings + 1)[1:-1])
        k = np.unique(np.append(k, len(fine) - 1))
        r, z, tilt = r[k], z[k], (tilt[k] + tilt[np.minimum(k + 1, len(fine) - 1)]) / 2
        turn = 2 * np.pi * np.arange(around) / around

        def ring(r: Any, z: Any) -> Array:
            return np.stack([r * np.cos(turn), r * np.sin(turn), np.broadcast_to(z, turn.shape)], -1)

        off = (turn + np.pi / 6) % (np.pi / 3) - np.pi / 6
        rows = [ring(r_, z_) for r_, z_ in zip(r, z, strict=True)]
        outward = [ring(np.sin(b), np.cos(b)) for b in tilt]
        hexagon = ring(self.pitch / 2 / np.cos(off), 0.0)
        up = np.broadcast_to([0.0, 0.0, 1.0], hexagon.shape)
        self.vertices = np.concatenate([[[0.0, 0.0, self.height]], *rows, rows[-1], hexagon])
        self.normals = np.concatenate([[[0.0, 0.0, 1.0]], *outward, up, up])
        i = np.arange(around)
        j = (i + 1) % around

        def band(inner: int, outer: int) -> Array:
            a, b = 1 + inner * around, 1 + outer * around
            return np.concatenate([np.column_stack([a + i, b + i, b + j]), np.column_stack([a + i, b + j, a + j])])

        cap = np.column_stack([np.zeros(around, int), 1 + i, 1 + j])
        dome = np.concatenate([cap, *(band(n, n + 1) for n in range(len(r) - 1))])
        floor = band(len(r), len(r) + 1)
        self.dome = len(dome)
        self.triangles = np.concatenate([dome, floor])
        a, b, c = (self.vertices[column] for column in self.triangles.T)
        cross = np.cross(b - a, c - a)
        self.areas = np.linalg.norm(cross, axis=1) / 2
        some = self.areas > 1e-9  # where domes touch there is no floor
        self.triangles, self.areas, cross = self.triangles[some], self.areas[some], cross[some]
        self.flat_normals = cross / (2 * self.areas[:, None])

    @property
    def cell_area(self) -> float:
        """Of the hexagon, a^2."""
        return math.sqrt(3) / 2 * self.pitch**2


class Patch:
    """A disc of tiles, the outer ones coarser.

    Parameters
    ----------
    cell : Cell
        The shape; its domes all alike.
    fine : float
        Radius within which the tiles have `rings` and `around`, a; outside, a third of that.
    reach : float
        Radius of the disc, a. Body light needs it: some leaves tall domes almost level, and comes down far away.
    rings, around : int
        As for `Tile`; around a multiple of 36.
    """

    def __init__(self, cell: Cell, fine: float = 8.0, reach: float = 40.0, rings: int = 42, around: int = 72) -> None:
        self.tile, self.coarse = Tile(cell, rings, around), Tile(cell, rings // 3, around // 3)
        pitch = self.tile.pitch
        n = math.ceil(reach / pitch * 2 / math.sqrt(3)) + 1
        i, j = (a.ravel() for a in np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1)))
        self.a1, self.a2 = np.array([pitch, 0.0, 0.0]), np.array([pitch / 2, pitch * math.sqrt(3) / 2, 0.0])
        places = i[:, None] * self.a1 + j[:, None] * self.a2
        away = np.hypot(places[:, 0], places[:, 1])
        self.near, self.far = places[away <= fine], places[(away > fine) & (away <= reach)]

    def mesh(self, bsdf: Any, **settings: Any) -> Any:
        """As one Mitsuba mesh with flat triangles."""
        mi = mitsuba()
        vertices, triangles = np.empty((0, 3)), np.empty((0, 3), int)
        for tile, places in ((self.tile, self.near), (self.coarse, self.far)):
            first = len(vertices) + np.arange(len(places)) * len(tile.vertices)
            vertices = np.concatenate([vertices, (places[:, None] + tile.vertices).reshape(-1, 3)])
            triangles = np.concatenate([triangles, (first[:, None, None] + tile.triangles).reshape(-1, 3)])
        properties = mi.Properties()
        properties["bsdf"] = bsdf
        properties["face_normals"] = True
        for name, value in settings.items():
            properties[name] = value
        mesh = mi.Mesh("domes", len(vertices), len(triangles), props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
        parameters["faces"] = triangles.astype(np.uint32).ravel()
        parameters.update()
        return mesh

    def camera(self, view: Array, pixels: int, samples: int) -> Any:
        """Orthographic sensor whose film is exactly one period of the patch, as seen from `view`: its mean is the patch's radiance."""
        mi = mitsuba()
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = self.a1 / 2, self.a2 / 2, -view
        matrix[:3, 3] = view * (1.01 * self.tile.height + 0.1) / view[2]
        return mi.load_dict(
            {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f(matrix),
                "near_clip": 1e-3,
                "far_clip": 1e5,
                "film": {
                    "type": "hdrfilm",
                    "width": pixels,
                    "height": pixels,
                    "pixel_format": "rgb",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": samples},
            }
        )


class Opaque:
    """Lambert domes and floor in a beam of light."""

    def __init__(self, patch: Patch) -> None:
        mi = mitsuba()
        self.patch = patch
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "domes": patch.mesh(mi.load_dict({"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}})),
                "sun": {"type": "directional", "direction": [0.0, 0.0, -1.0], "irradiance": 1.0},
            }
        )
        self.parameters = mi.traverse(self.scene)

    def render(self, direction: Direction, turn: float, bounces: int, albedo: float, seed: int, pixels: int, samples: int) -> float:
        """f_r with up to so many bounces (-1: all), at one azimuth of the lattice, 1/sr."""
        mi = mitsuba()
        theta_i, theta_r, phi = direction
        light = towards(theta_i, turn)
        to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=list(-light), up=[-light[1], light[0] + 1e-9, 0.5])
        self.parameters["sun.to_world"] = to_world if not vectorised() else mi.AffineTransform4f(to_world)
        self.parameters["domes.bsdf.reflectance.value"] = albedo
        self.parameters.update()
        integrator = mi.load_dict({"type": "path", "max_depth": bounces + 1 if bounces >= 0 else -1, "rr_depth": 12})
        sensor = self.patch.camera(towards(theta_r, turn + phi), pixels, samples)
        image = mi.render(self.scene, sensor=sensor, integrator=integrator, seed=seed, spp=samples)
        return float(np.array(image).mean()) / light[2]

    def reflectance(
        self, direction: Direction, *, bounces: int = 1, albedo: float = 1.0, strata: int = 24, rays: int = 8192, seed: int = 0
    ) -> Estimate:
        """f_r of light with up to so many bounces (-1: all), averaged over the lattice's azimuth, 1/sr."""
        return Estimate.of_pairs(
            np.array([self._each(direction, n, pair, (bounces,), albedo, rays, seed) for n, pair in enumerate(azimuths(strata, seed))])
        )

    def orders(self, direction: Direction, count: int, *, strata: int = 24, rays: int = 8192, seed: int = 0) -> Estimate:
        """f_r of light after 1, 2 ... `count` bounces at albedo 1, shape (count,), 1/sr."""
        return Estimate.of_pairs(
            np.array(
                [
                    np.diff(self._each(direction, n, pair, tuple(range(1, count + 1)), 1.0, rays, seed), axis=-1, prepend=0.0)
                    for n, pair in enumerate(azimuths(strata, seed))
                ]
            )
        )

    def _each(self, direction: Direction, row: int, pair: Array, bounces: tuple[int, ...], albedo: float, rays: int, seed: int) -> Array:
        """Shape (2, len(bounces)); the same random numbers for every number of bounces, so that their differences are quiet."""
        return np.array(
            [
                [self.render(direction, turn, count, albedo, 2 * (row + 1000 * seed) + n, 32, rays // 1024) for count in bounces]
                for n, turn in enumerate(pair)
            ]
        )

    def free(self, points: Array, directions: Array) -> NDArray[np.bool_]:
        """Whether nothing is in the way of rays from the points."""
        mi = mitsuba()
        if vectorised():
            return ~np.array(self.scene.ray_test(mi.Ray3f(mi.Point3f(*points.T), mi.Vector3f(*directions.T))))
        ray, test = mi.Ray3f, self.scene.ray_test
        return np.array([not test(ray(o, d)) for o, d in zip(points.tolist(), directions.tolist(), strict=True)])

    def terms(
        self, direction: Direction, n_us: float, *, foreshortened: bool, strata: int = 24, points: int = 2000, seed: int = 0
    ) -> Estimate:
        """Diffuse and specular sum, averaged over the lattice's azimuth, shape (2,).

        Paper mode (not foreshortened): (1/alpha) Int l v (N.L, max(0, R.V)^n) over the dome. Radiometric: (1/alpha) Int l v N.L N.V
        (1/pi, (n+2)/(2 pi) max(0, R.V)^n) / (cos theta_i cos theta_r) over dome and floor. `points` for each azimuth lie on triangles drawn
        by what these are worth there.
        """
        rng = np.random.default_rng(seed)
        tile = self.patch.tile
        theta_i, theta_r, phi = direction
        turns = azimuths(strata, seed).ravel()
        lights = np.array([towards(theta_i, turn) for turn in turns])
        views = np.array([towards(theta_r, turn + phi) for turn in turns])
        used = slice(None) if foreshortened else slice(tile.dome)
        triangles, areas, flat = tile.triangles[used], tile.areas[used], tile.flat_normals[used]
        corners, bent = tile.vertices[triangles], tile.normals[triangles]

        def worth(normals: Array, light: Array, view: Array) -> Array:
            cos_l, cos_v = (normals * light).sum(-1), (normals * view).sum(-1)
            lobe = np.maximum(0, 2 * cos_l * cos_v - (light * view).sum(-1)) ** n_us * ((cos_l > 0) & (cos_v > 0))
            cos_l = np.maximum(0, cos_l) * (cos_v > 0)
            return np.stack([cos_l, lobe * cos_l if foreshortened else lobe], -1) * (cos_v[..., None] if foreshortened else 1.0)

        places, normals, weights, starts = [], [], [], []
        for light, view in zip(lights, views, strict=True):
            likely = areas[:, None] * np.sqrt(worth(flat, light, view))
            share = 0.45 * (likely / np.maximum(likely.sum(0), 1e-300)).sum(1) + 0.1 * areas / areas.sum()
            share /= share.sum()
            drawn = np.minimum(np.searchsorted(np.cumsum(share), (np.arange(points) + rng.random(points)) / points), len(share) - 1)
            u, v = np.sqrt(rng.random(points)), rng.random(points)
            coordinates = np.stack([1 - u, u * (1 - v), u * v], -1)
            normal = np.einsum("nk,nkc->nc", coordinates, bent[drawn])
            places.append(np.einsum("nk,nkc->nc", coordinates, corners[drawn]))
            normals.append(normal / np.linalg.norm(normal, axis=1)[:, None])
            weights.append(areas[drawn] / share[drawn] / points / tile.cell_area)
            starts.append(places[-1] + 1e-4 * flat[drawn])
        each_light, each_view = np.repeat(lights, points, 0), np.repeat(views, points, 0)
        start = np.concatenate(starts)
        value = worth(np.concatenate(normals), each_light, each_view) * np.concatenate(weights)[:, None]
        some = value.any(axis=1)
        value[some] *= (self.free(start[some], each_light[some]) & self.free(start[some], each_view[some]))[:, None]
        sums = value.reshape(strata, 2, points, 2).sum(2)
        if foreshortened:
            sums *= np.array([1, (n_us + 2) / 2]) / (math.pi * lights[0, 2] * views[0, 2])
        return Estimate.of_pairs(sums)


class Dielectric:
    """Domes and floor as the smooth surface of a clear or absorbing body.

    What lies below glows red and the sky green, so that one picture tells what share of the rays from a sensor ends at either.

    Parameters
    ----------
    patch : Patch
    depth : float
        Of the body below the floor, a.
    n : float
        Its refractive index.
    below : str or float
        "base": the body stands on a black base that glows; "air": its lower face is flat and smooth, and the base glows behind; a number:
        it stands on a Lambert base of that reflectance, which does not glow.
    """

    def __init__(self, patch: Patch, depth: float, n: float, below: str | float = "base") -> None:
        mi = mitsuba()
        self.patch, self.n = patch, n
        place = mi.ScalarTransform4f
        pigment = mi.load_dict({"type": "homogeneous", "albedo": 0.0, "sigma_t": 1.0})
        smooth = mi.load_dict({"type": "dielectric", "int_ior": n, "ext_ior": 1.0})
        red, green = ({"type": "rgb", "value": value} for value in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
        black: dict[str, Any] = {"bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}}
        glowing = black | {"emitter": {"type": "area", "radiance": red}}
        wide = place().translate([0, 0, -depth]).scale([1000, 1000, 1])
        parts: dict[str, Any] = {"domes": patch.mesh(smooth, interior=pigment), "sky": {"type": "constant", "radiance": green}}
        if below == "base":
            # The meter sees from one period of the base, a hair above the rest of it.
            period = np.eye(4)
            period[:3, 0], period[:3, 1], period[2, 3] = patch.a1 / 2, patch.a2 / 2, 1e-3 - depth
            film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "rgb", "rfilter": {"type": "box"}}
            meter = {"type": "irradiancemeter", "film": film, "sampler": {"type": "independent"}, "medium": pigment}
            parts["base"] = {"type": "rectangle", "to_world": wide} | glowing
            parts["period"] = {"type": "rectangle", "to_world": place(period), "sensor": meter} | glowing
        elif below == "air":
            down = wide @ place().rotate([1, 0, 0], 180)
            parts["lower"] = {"type": "rectangle", "to_world": down, "bsdf": smooth, "interior": pigment}
            parts["base"] = {"type": "rectangle", "to_world": place().translate([0, 0, -1]) @ wide} | glowing
        else:
            lambert = {"type": "diffuse", "reflectance": {"type": "uniform", "value": float(below)}}
            parts["base"] = {"type": "rectangle", "to_world": wide, "bsdf": lambert}
        self.in_body = below == "base"
        self.scene = mi.load_dict({"type": "scene"} | parts)
        self.integrator = mi.load_dict({"type": "volpath", "max_depth": 500, "rr_depth": 1000})
        self.parameters = mi.traverse(self.scene)

    def absorbing(self, mu: float) -> Dielectric:
        """Set the body's absorption, 1/a."""
        for name in [name for name in self.parameters.keys() if name.endswith("sigma_t.value.value")]:  # noqa: SIM118 - no dict
            self.parameters[name] = max(mu, 1e-7)
        self.parameters.update()
        return self

    def from_air(self, theta: float, *, strata: int = 12, rays: int = 16384, seed: int = 0) -> Estimate:
        """Shares of light from theta (deg) that end at what glows below and in the sky, shape (2,)."""
        return Estimate.of_pairs(
            np.array(
                [
                    [
                        self._picture(self.patch.camera(towards(theta, turn), 32, rays // 1024), rays // 1024, 2 * (row + 1000 * seed) + n)
                        for n, turn in enumerate(pair)
                    ]
                    for row, pair in enumerate(azimuths(strata, seed))
                ]
            )
            * [self.n**2 if self.in_body else 1, 1]  # radiance falls by n^2 on its way out
        )

    def from_base(self, *, repeats: int = 8, rays: int = 65536, seed: int = 0) -> Estimate:
        """Shares of the base's Lambert light that come back to it and leave into the air, shape (2,)."""
        sensor = self.scene.sensors()[0]
        seen = np.array([[self._picture(sensor, rays, 2 * (row + 1000 * seed) + n) for n in (0, 1)] for row in range(repeats)])
        return Estimate.of_pairs(seen / math.pi / [1, self.n**2])

    def _picture(self, sensor: Any, samples: int, seed: int) -> Array:
        mi = mitsuba()
        image = np.array(mi.render(self.scene, sensor=sensor, integrator=self.integrator, seed=seed, spp=samples), float)
        return np.asarray(image.mean((0, 1))[:2])
