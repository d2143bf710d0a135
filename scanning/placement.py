"""How the petals of a flower stand, as written down while it was taken apart: `placement.toml`.

Each petal names its left neighbour (the next one counter-clockwise seen from above) and its right one, says whether that neighbour lies
`inside` (towards the stem) or `outside` of it, and has the measured angle to the stem, azimuth and base position with standard
uncertainties. The order in which the petals were taken off, outermost first, may be given for the whole flower: it settles which of two
petals lies inside where they are no neighbours.
"""

import math
import re
import tomllib
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanning.errors import ScanError

SIDES = {"inside": "outside", "outside": "inside"}
OPPOSITE = {"left": "right", "right": "left"}
ANGLE_U, BASE_U = 3.0, 1.0  # deg and mm: what a protractor and a ruler at a cut flower are worth, unless the file says otherwise
_NUMBERS = {  # key: lowest, highest; the highest itself is allowed
    "stem_angle": (0.0, 180.0),
    "stem_angle_u": (0.05, 45.0),
    "azimuth": (-360.0, 360.0),
    "azimuth_u": (0.05, 45.0),
    "base_radius": (0.0, 100.0),
    "base_height": (-100.0, 100.0),
    "base_u": (0.01, 20.0),
}
_UNITS = {"stem_angle": "degrees", "stem_angle_u": "degrees", "azimuth": "degrees", "azimuth_u": "degrees"}
_FLOWER_NUMBERS = {"receptacle_radius": _NUMBERS["base_radius"], "receptacle_height": _NUMBERS["base_height"]}


class PlacementError(ScanError):
    """A placement that cannot be used; the message lists everything that is wrong, each with its line."""


@dataclass(frozen=True)
class Neighbour:
    """A neighbouring petal, and whether it lies `inside` or `outside` of the petal that names it."""

    petal: str
    side: str


@dataclass(frozen=True)
class PetalPlacement:
    """One petal's measurements; degrees and mm."""

    name: str
    left: Neighbour | None
    right: Neighbour | None
    stem_angle: float
    azimuth: float
    base_radius: float
    base_height: float
    stem_angle_u: float = ANGLE_U
    azimuth_u: float = ANGLE_U
    base_u: float = BASE_U

    def neighbours(self) -> dict[str, Neighbour]:
        """Return the neighbours that are given, by `left` and `right`."""
        return {hand: n for hand, n in (("left", self.left), ("right", self.right)) if n is not None}


@dataclass(frozen=True)
class Placement:
    """A flower's petals by name, with the lines of the file that they came from (for messages)."""

    flower: str
    petals: dict[str, PetalPlacement]
    taken_off: tuple[str, ...] = ()  # outermost first: the order in which the petals came off the flower, where it was noted
    source: str = "placement"
    lines: dict[tuple[str, ...], int] = field(default_factory=dict, compare=False)

    def inside_of(self) -> list[tuple[str, str]]:
        """Return each pair (inner, outer) that some petal states, once."""
        pairs = set()
        for petal in self.petals.values():
            for neighbour in petal.neighbours().values():
                pairs.add((neighbour.petal, petal.name) if neighbour.side == "inside" else (petal.name, neighbour.petal))
        return sorted(pairs)


@dataclass(frozen=True)
class Problem:
    """Something wrong in a placement: `line` is None where no line of a file is to blame."""

    source: str
    line: int | None
    text: str

    def __str__(self) -> str:
        return f"{self.source}:{self.line}: {self.text}" if self.line else f"{self.source}: {self.text}"


def read(path: Path) -> Placement:
    """Read a `placement.toml`.

    Raises
    ------
    PlacementError
        Listing all keys of a wrong name, type or range, or the place where the file is not TOML.
    """
    placement, problems = examine(path)
    if problems:
        raise PlacementError("\n".join(map(str, problems)))
    return placement


def examine(path: Path, petals: Collection[str] | None = None) -> tuple[Placement, list[Problem]]:
    """Read a `placement.toml` and return what could be read with ALL that is wrong.

    Parameters
    ----------
    path : the file.
    petals : names of the petals that have meshes; given, the petals' relations are checked as well (see `check`).

    Raises
    ------
    PlacementError
        If there is no such file, or it is not TOML.
    """
    source = str(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise PlacementError(f"{path}: cannot be read as UTF-8 text ({error}): a placement.toml was expected") from error
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise PlacementError(f"{path}: not TOML: {error}") from error
    lines = _line_index(text)
    placement, problems = _from_table(table, source, lines)
    if petals is not None:
        problems += check(placement, petals)
    return placement, sorted(problems, key=lambda problem: problem.line or 0)


def check(placement: Placement, petals: Collection[str]) -> list[Problem]:
    """Return everything that keeps a placement from being assembled.

    Parameters
    ----------
    placement : from `read` or `examine`.
    petals : names of the petals that have meshes.
    """
    problems: list[Problem] = []

    def problem(where: tuple[str, ...], text: str) -> None:
        problems.append(Problem(placement.source, _line(placement.lines, where), text))

    for name, petal in placement.petals.items():
        if name not in petals:
            problem(("petals", name), f"{name} has no mesh: import its scan, or take [petals.{name}] out")
        for hand in OPPOSITE:
            neighbour = petal.neighbours().get(hand)
            where = ("petals", name, hand)
            if neighbour is None:
                if len(placement.petals) > 1 and where not in placement.lines:
                    problem(
                        ("petals", name), f'{name} has no {hand} neighbour: give {hand} = {{ petal = "...", side = "inside" or "outside" }}'
                    )
                continue
            if neighbour.petal == name:
                problem(where, f"{name} is its own {hand} neighbour")
                continue
            other = placement.petals.get(neighbour.petal)
            if other is None:
                problem(where, f"{name} has {neighbour.petal} for {hand} neighbour, but there is no [petals.{neighbour.petal}]")
                continue
            back = other.neighbours().get(OPPOSITE[hand])
            if back is None:
                continue  # named where that petal is looked at
            if back.petal != name:
                text = f"{name} says {hand} = {other.name}, but {other.name} says {OPPOSITE[hand]} = {back.petal}: one of the two is wrong"
                problem(where, text)
            elif back.side != SIDES[neighbour.side] and hand == "left":
                line = _line(placement.lines, ("petals", other.name, OPPOSITE[hand]))
                text = f"{name} says {other.name} is {neighbour.side}, but {other.name} says {name} is {back.side}" + (
                    f" (line {line})" if line else ""
                )
                problem(where, f"{text}: one of the two must be {SIDES[neighbour.side]}")
    problems += [
        Problem(placement.source, None, f"{name} has a mesh but no [petals.{name}]: add its placement")
        for name in petals
        if name not in placement.petals
    ]
    for name in placement.taken_off:
        if name not in placement.petals:
            problem(("flower", "taken_off"), f"taken_off names {name}, but there is no [petals.{name}]")
    turn = {name: place for place, name in enumerate(placement.taken_off)}
    for inner, outer in placement.inside_of():
        if inner in turn and outer in turn and turn[inner] < turn[outer]:
            problem(("flower", "taken_off"), f"{inner} came off before {outer}, but is said to be inside of it")
    cycle = _cycle(placement.inside_of())
    if cycle:
        chain = " inside ".join([*cycle, cycle[0]])
        problem(("petals", cycle[0]), f"the petals lie inside each other in a circle: {chain}: turn one of these relations round")
    return problems


def write(path: Path, placement: Placement) -> None:
    """Write a placement as `placement.toml`."""
    lines = ["[flower]", f"name = {_quoted(placement.flower)}"]
    if placement.taken_off:
        lines.append(f"taken_off = [{', '.join(map(_quoted, placement.taken_off))}]")
    for name, petal in placement.petals.items():
        lines += ["", f"[petals.{name if re.fullmatch('[A-Za-z0-9_-]+', name) else _quoted(name)}]"]
        for hand, neighbour in petal.neighbours().items():
            lines.append(f"{hand} = {{ petal = {_quoted(neighbour.petal)}, side = {_quoted(neighbour.side)} }}")
        lines += [f"{key} = {float(getattr(petal, key))!r}" for key in _NUMBERS]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _from_table(table: dict[str, Any], source: str, lines: dict[tuple[str, ...], int]) -> tuple[Placement, list[Problem]]:
    problems: list[Problem] = []

    def problem(where: tuple[str, ...], text: str) -> None:
        problems.append(Problem(source, _line(lines, where), text))

    def number(values: dict[str, Any], key: str, limits: tuple[float, float], where: tuple[str, ...], default: float | None) -> float:
        value = values.get(key)
        low, high = limits
        if value is None:
            if default is None:
                problem(where, f"{'.'.join(where)} has no {key}: give it in {_UNITS.get(key, 'mm')}")
            return math.nan if default is None else default
        if isinstance(value, bool) or not isinstance(value, int | float):
            problem((*where, key), f"{key} = {value!r} is not a number of {_UNITS.get(key, 'mm')}")
            return math.nan
        if not low <= value <= high:
            problem((*where, key), f"{key} = {value!r} is outside {low:g} to {high:g} {_UNITS.get(key, 'mm')}")
        return float(value)

    def neighbour(values: dict[str, Any], hand: str, where: tuple[str, ...]) -> Neighbour | None:
        value = values.get(hand)
        if value is None:
            return None
        if isinstance(value, dict) and isinstance(value.get("petal"), str) and value.get("side") in SIDES and len(value) == 2:
            return Neighbour(value["petal"], value["side"])
        problem((*where, hand), f'{hand} = {value!r} is not {{ petal = "...", side = "inside" or "outside" }}')
        return None

    flower = table.get("flower", {})
    if not isinstance(flower, dict) or not isinstance(flower.get("name"), str):
        problem(("flower",), '[flower] has no name = "..."')
        flower = {} if not isinstance(flower, dict) else flower
    known_tables = {"flower", "petals"}
    for key in table.keys() - known_tables:
        problem((key,), f"unknown key {key}: known are {', '.join(sorted(known_tables))}")
    known = {"name", "taken_off", *_FLOWER_NUMBERS}
    for key in flower.keys() - known:
        problem(("flower", key), f"unknown key {key} in [flower]: known are {', '.join(sorted(known))}")
    receptacle = {key: number(flower, key, limits, ("flower",), None) for key, limits in _FLOWER_NUMBERS.items() if key in flower}
    taken_off = flower.get("taken_off", [])
    if not isinstance(taken_off, list) or not all(isinstance(name, str) for name in taken_off) or len(set(taken_off)) < len(taken_off):
        problem(("flower", "taken_off"), f"taken_off = {taken_off!r} is not a list of different petals' names, outermost first")
        taken_off = []
    petals: dict[str, PetalPlacement] = {}
    tables = table.get("petals")
    if not isinstance(tables, dict) or not tables:
        problem(("petals",), "no petals: give a table [petals.P01] for each")
        tables = {}
    known = {"left", "right", *_NUMBERS}
    for name, values in tables.items():
        where = ("petals", name)
        if not isinstance(values, dict):
            problem(where, f"petals.{name} = {values!r} is not a table of its measurements")
            continue
        for key in values.keys() - known:
            problem((*where, key), f"unknown key {key} in [petals.{name}]: known are {', '.join(sorted(known))}")
        defaults = {
            "stem_angle_u": ANGLE_U,
            "azimuth_u": ANGLE_U,
            "base_u": BASE_U,
            "base_radius": receptacle.get("receptacle_radius"),
            "base_height": receptacle.get("receptacle_height"),
        }
        numbers = {key: number(values, key, limits, where, defaults.get(key)) for key, limits in _NUMBERS.items()}
        petals[name] = PetalPlacement(name=name, left=neighbour(values, "left", where), right=neighbour(values, "right", where), **numbers)
    return Placement(str(flower.get("name", "")), petals, tuple(taken_off), source, lines), problems


def _cycle(pairs: list[tuple[str, str]]) -> list[str]:
    """Return the petals of one circle of (inner, outer) pairs, in order; empty when there is none."""
    outer: dict[str, list[str]] = {}
    for a, b in pairs:
        outer.setdefault(a, []).append(b)
    done: set[str] = set()
    for start in sorted(outer):
        path, branches = [start], [iter(outer[start])]
        while path:
            following = next(branches[-1], None)
            if following is None:
                done.add(path.pop())
                branches.pop()
            elif following in path:
                return path[path.index(following) :]
            elif following not in done:
                path.append(following)
                branches.append(iter(outer.get(following, [])))
    return []


_KEY = r"(?:[A-Za-z0-9_-]+|\"(?:[^\"\\]|\\.)*\"|'[^']*')"
_DOTTED = re.compile(rf"\s*({_KEY}(?:\s*\.\s*{_KEY})*)\s*")


def _line_index(text: str) -> dict[tuple[str, ...], int]:
    """Return the line of each table header and key: tomllib gives none. Multi-line strings may add keys that nobody asks for."""
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(rf"\s*\[\[?{_DOTTED.pattern}\]", line)
        entry = re.match(rf"{_DOTTED.pattern}=", line)
        if header:
            table = _parts(header[1])
            path = table
        elif entry:
            path = table + _parts(entry[1])
        else:
            continue
        for depth in range(1, len(path) + 1):
            lines.setdefault(path[:depth], number)
    return lines


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part[1:-1] if part[0] in "\"'" else part for part in re.findall(_KEY, dotted))


def _line(lines: dict[tuple[str, ...], int], where: tuple[str, ...]) -> int | None:
    return next((lines[where[:depth]] for depth in range(len(where), 0, -1) if where[:depth] in lines), None)
