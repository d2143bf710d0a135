"""One file for arrays and what they are: nothing that is wrong with it goes unseen."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fitting import archive
from fitting.errors import DomainError, TableError

FORMAT = "things 1"
ABOUT = {"names": ["a", "b"], "nested": {"x": 1.5, "none": None}, "sort": "Rosé"}
ARRAYS = {
    "part.values": np.random.default_rng(0).random((3, 4, 5)).astype(np.float32),
    "nodes": np.array([0.0, math.pi, math.inf, math.nan]),
    "counts": np.arange(6).reshape(2, 3),
    "empty": np.empty((0, 2)),
    "yes": np.array([True, False]),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    archive.write(tmp_path / "it.npz", FORMAT, ABOUT, ARRAYS)
    return tmp_path / "it.npz"


def test_what_is_read_is_what_was_written(path: Path) -> None:
    about, arrays = archive.read(path, FORMAT)
    assert about == ABOUT
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays[name], array)


def test_the_order_of_bytes_and_the_layout_do_not_count(path: Path, tmp_path: Path) -> None:
    other = {name: np.asfortranarray(array.astype(array.dtype.newbyteorder(">"))) for name, array in ARRAYS.items()}
    archive.write(tmp_path / "other.npz", FORMAT, ABOUT, other)
    with np.load(path) as one, np.load(tmp_path / "other.npz") as two:
        assert json.loads(str(one["about"]))["sha256"] == json.loads(str(two["about"]))["sha256"]
    np.testing.assert_array_equal(archive.read(tmp_path / "other.npz", FORMAT)[1]["counts"], ARRAYS["counts"])


def change(path: Path, what: str) -> None:
    """Rewrite a stored file with something changed, its sum left as it was."""
    with np.load(path) as stored:
        found = dict(stored)
    known = json.loads(str(found["about"]))
    if what == "value":
        found["part.values"][1, 2, 3] *= np.float32(1.0001)
    elif what == "shape":
        found["counts"] = found["counts"].reshape(3, 2)
    elif what == "kind":
        found["counts"] = found["counts"].astype(float)
    elif what == "name":
        found["others"] = found.pop("counts")
    elif what == "more":
        found["more"] = np.zeros(1)
    elif what == "less":
        del found["yes"]
    elif what == "about":
        known["about"]["nested"]["x"] = 1.6
    elif what == "sum":
        known["sha256"] = known["sha256"][::-1]
    elif what == "format":
        known["format"] = "things 2"
    elif what == "no format":
        del known["format"]
    elif what == "list":
        known = [known]
    found["about"] = np.array(json.dumps(known))
    np.savez(path, **found)


@pytest.mark.parametrize("what", ["value", "shape", "kind", "name", "more", "less", "about", "sum", "format", "no format", "list"])
def test_a_changed_file_is_refused(what: str, path: Path) -> None:
    change(path, "nothing")
    archive.read(path, FORMAT)
    change(path, what)
    with pytest.raises(TableError, match=r"it\.npz: not a file of the format 'things 1'.*make it again"):
        archive.read(path, FORMAT)


@pytest.mark.parametrize("what", ["missing", "folder", "text", "empty", "array", "foreign", "pickled"])
def test_a_foreign_file_is_refused(what: str, path: Path) -> None:
    path.unlink()
    if what == "folder":
        path.mkdir()
    elif what == "text":
        path.write_text("theta_i,theta_r\n")
    elif what == "empty":
        path.touch()
    elif what == "array":
        with path.open("wb") as file:
            np.save(file, np.arange(3))
    elif what == "foreign":
        np.savez(path, other=np.arange(3))
    elif what == "pickled":
        np.savez(path, about=np.array({"format": FORMAT}, dtype=object))
    with pytest.raises(TableError, match=r"it\.npz: not a file of the format"):
        archive.read(path, FORMAT)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_refused_or_says_the_same(data: st.DataObject, path: Path, tmp_path: Path) -> None:
    """Where a flipped bit or a lost tail is in nothing that counts, such as a date in the container, all the content is still right."""
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans(), label="cut"):
        content = content[: data.draw(st.integers(0, len(content) - 1), label="at")]
    else:
        content[data.draw(st.integers(0, len(content) - 1), label="byte")] ^= 1 << data.draw(st.integers(0, 7), label="bit")
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(content)
    try:
        about, arrays = archive.read(damaged, FORMAT)
    except TableError:
        return
    assert about == ABOUT
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)


@pytest.mark.parametrize(
    ("about", "arrays", "message"),
    [
        ({"cell": object()}, ARRAYS, "JSON"),
        (ABOUT, {"about": np.zeros(2)}, "another|other than"),
        (ABOUT, {"": np.zeros(2)}, "cannot be stored"),
        (ABOUT, {"things": np.array([object()])}, "cannot be stored"),
        (ABOUT, {"words": np.array(["a"])}, "cannot be stored"),
    ],
)
def test_what_no_such_file_can_hold(about: dict[str, Any], arrays: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(DomainError, match=message):
        archive.write(tmp_path / "no.npz", FORMAT, about, arrays)
    assert not (tmp_path / "no.npz").exists()
