"""placement.toml: what is wrong is said at once, with its line."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanning.placement import Neighbour, PetalPlacement, Placement, PlacementError, check, examine, read, write

GOOD = """\
[flower]
name = "three"
taken_off = ["P03", "P02", "P01"]

[petals.P01]
left = { petal = "P02", side = "outside" }
right = { petal = "P03", side = "outside" }
stem_angle = 20
azimuth = 0.0
base_radius = 2.0
base_height = 1.0

[petals.P02]
left = { petal = "P03", side = "outside" }
right = { petal = "P01", side = "inside" }
stem_angle = 30.0
stem_angle_u = 2.0
azimuth = 120.0
base_radius = 2.5
base_height = 1.0

[petals.P03]
left = { petal = "P01", side = "inside" }
right = { petal = "P02", side = "inside" }
stem_angle = 40.0
azimuth = 240.0
base_radius = 3.0
base_height = 1.0
"""
NAMES = ["P01", "P02", "P03"]


def problems(tmp_path: Path, text: str, names: list[str] = NAMES) -> list[tuple[int | None, str]]:
    path = tmp_path / "placement.toml"
    path.write_text(text)
    return [(problem.line, problem.text) for problem in examine(path, names)[1]]


def line_of(text: str, piece: str) -> int:
    return text[: text.index(piece)].count("\n") + 1


def test_a_good_file_is_read_as_it_is(tmp_path: Path) -> None:
    assert problems(tmp_path, GOOD) == []
    placement = read(tmp_path / "placement.toml")
    assert placement.petals["P02"] == PetalPlacement(
        "P02", Neighbour("P03", "outside"), Neighbour("P01", "inside"), 30.0, 120.0, 2.5, 1.0, stem_angle_u=2.0
    )
    assert placement.inside_of() == [("P01", "P02"), ("P01", "P03"), ("P02", "P03")]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("stem_angle = 30.0\n", "stem_angle = 300.0\n", "outside 0 to 180"),
        ("azimuth = 120.0", 'azimuth = "north"', "not a number"),
        ("azimuth = 120.0", "azimuth = true", "not a number"),
        ("azimuth = 120.0", "azimuth = nan", "outside"),
        ("stem_angle_u = 2.0", "stem_angel_u = 2.0", "unknown key stem_angel_u"),
        ('left = { petal = "P03", side = "outside" }', 'left = { petal = "P03", side = "above" }', "inside"),
        ('left = { petal = "P03", side = "outside" }', 'left = { petal = "P09", side = "outside" }', "no [petals.P09]"),
        ('left = { petal = "P03", side = "outside" }', 'left = { petal = "P03", side = "inside" }', "one of the two must be"),
        ('left = { petal = "P03", side = "outside" }', 'left = { petal = "P02", side = "inside" }', "its own left neighbour"),
        ('left = { petal = "P03", side = "outside" }', 'left = { petal = "P01", side = "outside" }', "one of the two is wrong"),
        ('taken_off = ["P03", "P02", "P01"]', 'taken_off = ["P01", "P02", "P03"]', "came off before"),
        ('taken_off = ["P03", "P02", "P01"]', 'taken_off = ["P03", "P07"]', "names P07"),
        ('taken_off = ["P03", "P02", "P01"]', 'taken_off = "P03"', "not a list"),
        ('name = "three"', "nome = 1", "unknown key nome"),
    ],
)
def test_each_mistake_is_named_with_its_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert GOOD.count(old) == 1
    text = GOOD.replace(old, new)
    assert (line_of(text, new), True) in [(line, said in what) for line, what in problems(tmp_path, text)]


def test_all_mistakes_come_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = GOOD.replace("stem_angle = 20", "stem_angle = -1").replace("azimuth = 240.0\n", "").replace("azimuth = 120.0", "azimut = 120.0")
    found = problems(tmp_path, text, ["P01", "P02", "P04"])
    assert [line for line, _ in found if line] == sorted(line for line, _ in found if line)
    said = "\n".join(what for _, what in found)
    for piece in ("outside 0 to 180", "petals.P03 has no azimuth", "unknown key azimut", "P03 has no mesh", "P04 has a mesh but no"):
        assert piece in said
    with pytest.raises(PlacementError, match=r"placement.toml:8: stem_angle(?s:.*)unknown key azimut"):
        read(tmp_path / "placement.toml")


def test_a_missing_neighbour_is_named_at_its_petal(tmp_path: Path) -> None:
    text = GOOD.replace('left = { petal = "P03", side = "outside" }\n', "")
    assert (line_of(text, "[petals.P02]"), True) in [(line, "P02 has no left neighbour" in what) for line, what in problems(tmp_path, text)]


def test_a_circle_of_insides_is_named() -> None:
    petals = {
        name: PetalPlacement(name, Neighbour(left, "outside"), Neighbour(right, "inside"), 30, 0, 2, 1)
        for name, left, right in (("A", "B", "C"), ("B", "C", "A"), ("C", "A", "B"))
    }
    found = check(Placement("ring", petals), ["A", "B", "C"])
    assert [problem.text.split(":")[1].strip() for problem in found] == ["A inside B inside C inside A"]


def test_the_receptacle_stands_in_for_base_positions(tmp_path: Path) -> None:
    bare = "\n".join(line for line in GOOD.splitlines() if not line.startswith("base_"))
    assert sum("has no base_radius" in what for _, what in problems(tmp_path, bare)) == 3
    assert problems(tmp_path, bare.replace('"three"', '"three"\nreceptacle_radius = 4.5\nreceptacle_height = 0.5')) == []
    petal = read(tmp_path / "placement.toml").petals["P02"]
    assert (petal.base_radius, petal.base_height) == (4.5, 0.5)


def test_what_is_not_toml_is_refused_with_the_file_and_place(tmp_path: Path) -> None:
    (tmp_path / "placement.toml").write_text("[flower\n")
    with pytest.raises(PlacementError, match=r"placement.toml: not TOML.*line 1"):
        read(tmp_path / "placement.toml")
    with pytest.raises(PlacementError, match="cannot be read"):
        read(tmp_path / "none.toml")


@settings(max_examples=30)
@given(st.text(max_size=20), st.floats(0, 180), st.floats(-360, 360), st.floats(0, 100))
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, name: str, stem: float, azimuth: float, radius: float) -> None:
    path = tmp_path_factory.mktemp("p") / "placement.toml"
    petal = PetalPlacement("P 1", Neighbour("b.c", "inside"), None, stem, azimuth, radius, 0.5)
    write(path, Placement(name, {"P 1": petal}, ("P 1",)))
    again = read(path)
    assert (again.flower, again.petals, again.taken_off) == (name, {"P 1": petal}, ("P 1",))
