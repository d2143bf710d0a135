"""The `rig` command as a technician and as a program meet it."""

import csv
import io
import json
import math
import re
from pathlib import Path

import pytest

from rig.cli.main import COMMANDS, cli
from rig.trajectory import parse_angles
from tests.conftest import ROOT

SWEEP = ("sweep", "--cultivar", "RR", "--theta-r", "-60:60:20")


def test_help_lists_what_the_readme_lists() -> None:
    import click

    def commands(group: click.Group, prefix: str) -> set[str]:
        context = click.Context(group)
        found = set()
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            assert command is not None
            found |= commands(command, f"{prefix} {name}") if isinstance(command, click.Group) else {f"{prefix} {name}"}
            found |= {f"{prefix} {name}"} if isinstance(command, click.Group) and command.invoke_without_command else set()
        return found

    table = re.findall(r"^\| `(rig [a-z ]+?)(?: [A-Z\[-].*?)?` \|", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(table) == commands(cli, "rig")


@pytest.mark.parametrize(
    "command", [[], *[[name] for name in COMMANDS], ["runs", "show"], ["runs", "note"], ["cultivars", "add"], ["model", "eval"]]
)
def test_every_help_has_an_example(rig, command: list[str]) -> None:
    assert re.search(r"Examples?:\n +rig ", rig(*command, "--help").stdout)


def test_help_imports_nothing_slow(rig) -> None:
    import subprocess
    import sys

    slow = ("numpy", "bluesky", "open3d", "numba", "matplotlib", "rich", "scipy")
    code = f"""
import sys
from rig.cli.main import main
try:
    main(["--help"])
except SystemExit:
    print([module for module in {slow!r} if module in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_a_sweep_from_the_bench_to_a_stored_fit(rig, tmp_path: Path) -> None:
    swept = rig(*SWEEP)
    run_id = swept.stdout.strip()
    assert "SIMULATED" in swept.stderr
    assert (tmp_path / "rig-data" / "runs" / run_id / "journal.jsonl").exists()
    assert "SIMULATED" in rig("runs").stdout
    shown = json.loads(rig("runs", "show", "latest", "--json").stdout)
    assert shown["state"] == "complete"
    assert [r["theta_r_setpoint"] for r in shown["readings"]] == list(parse_angles("-60:60:20", ""))
    assert "x" not in shown
    assert "SIMULATED" in rig("runs", "show", run_id).stdout

    fitted = json.loads(rig("fit", run_id[:-2], "--json").stdout)
    assert set(fitted["x"]) == {"u_diff", "u_spec", "s_diff", "s_spec"}
    assert all(value >= 0 for value in fitted["x"].values())
    assert fitted["E_mean"] == pytest.approx(sum(fitted["E"]) / 7)
    assert fitted["E_max"] == max(fitted["E"])
    assert fitted["provenance"]["run"] == run_id
    assert fitted["weights"] == "relative"
    assert fitted["simulated"] is True
    shown = json.loads(rig("runs", "show", "latest", "--json").stdout)
    assert {key: shown[key] for key in ("x", "E", "E_mean", "E_max")} == {key: fitted[key] for key in ("x", "E", "E_mean", "E_max")}
    assert "SIMULATED" in rig("fit", "--cultivar", "RR", "--weights", "plain", "--aspect", "1.9", "--no-page").stdout

    # One bad point, measured again into the same run.
    rig("sweep", "--redo", "latest", "--theta-r", "20")
    shown = json.loads(rig("runs", "show", "latest", "--json").stdout)
    assert [r["superseded"] for r in shown["readings"]] == [r["theta_r_setpoint"] == 20 for r in shown["readings"][:7]] + [False]
    assert shown["state"] == "complete"
    refitted = json.loads(rig("fit", "latest", "--no-page", "--json").stdout)
    assert refitted["measured"] != fitted["measured"]
    assert len(refitted["measured"]) == 7
    assert refitted["provenance"]["journal_sha256"] != fitted["provenance"]["journal_sha256"]
    assert "has no point" in rig("sweep", "--redo", "latest", "--theta-r", "25", check=1).stderr

    rig("runs", "note", "latest", "dew on the petal")
    assert "dew on the petal" in rig("runs", "show", "latest").stdout
    assert "no run 'nonsense'" in rig("fit", "nonsense", check=1).stderr
    assert "sigma" in rig("fit", "latest", "--weights", "sigma", check=1).stderr


@pytest.mark.slow
def test_repeats_give_a_sigma_to_weight_by(rig, tmp_path: Path) -> None:
    rig(*SWEEP, "--repeat", "3", "--out", "here")
    fitted = json.loads(rig("fit", "here", "--weights", "sigma", "--no-page", "--json").stdout)
    assert len(fitted["measured"]) == 7
    assert (tmp_path / "here" / "journal.jsonl").exists()
    assert "is there already" in rig(*SWEEP, "--out", "here", check=2).stderr


@pytest.mark.parametrize("angles", [("--theta-r", "-70:70:10"), ("--theta-r=-70:70:10",), ("--theta-r", "-70,0,70")])
def test_negative_values_with_a_space_and_with_equals(rig, angles: tuple[str, ...]) -> None:
    done = rig("sweep", "--cultivar", "BR", *angles, "--dry-run")
    assert re.search(r"^ +45 +-70 +1$", done.stdout, re.MULTILINE)


def test_a_dry_run_opens_and_leaves_nothing(rig, tmp_path: Path) -> None:
    done = rig("sweep", "--cultivar", "BR", "--dry-run")
    assert "15 readings, about" in done.stdout
    assert list(tmp_path.iterdir()) == []


BAD = {
    "unknown cultivar": (("sweep", "--cultivar", "XX"), 2, "known: BR, RR, PR, WR. Add it: rig cultivars add XX"),
    "no cultivar": (("sweep",), 2, "--cultivar is missing"),
    "outside the limits": (("sweep", "--cultivar", "RR", "--theta-r", "0:90:10"), 1, "outside its limits"),
    "inside the keep-out": (("sweep", "--cultivar", "RR", "--theta-r", "40:50:5"), 1, "blocks the light"),
    "bad angles": (("sweep", "--cultivar", "RR", "--theta-r", "a:b"), 2, "--theta-r 'a:b'"),
    "no such command": (("swep",), 2, "no command 'swep'"),
    "no such option": (("sweep", "--cultivars", "RR"), 2, "No such option"),
    "no such table": (("fit", "nowhere.csv"), 1, "no such file"),
    "nothing to fit": (("fit",), 2, "name what to fit"),
    "no runs": (("fit", "latest"), 1, "there are no runs"),
    "no complete run": (("fit", "--cultivar", "WR"), 1, "rig sweep --cultivar WR"),
    "figures without fits": (("figures",), 1, "rig fit --cultivar BR"),
    "missing configuration": (("--config", "none.toml", "sweep", "--cultivar", "RR"), 2, "none.toml"),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_are_one_line_with_the_right_exit_code(rig, tmp_path: Path, case: str) -> None:
    arguments, code, says = BAD[case]
    done = rig(*arguments, check=code)
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_is_not_there(rig, tmp_path: Path) -> None:
    rig("init")
    (tmp_path / "rig.toml").write_text((tmp_path / "rig.toml").read_text().replace("/dev/ttyUSB1", "/dev/ttyNONE"))
    done = rig("sweep", "--cultivar", "RR", check=1)
    assert "TransportTimeout: sensor on /dev/ttyNONE" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "rig-data" / "runs").iterdir())


def test_a_port_that_is_silent(rig, tmp_path: Path) -> None:
    import socket

    rig("init")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"socket://127.0.0.1:{silent.getsockname()[1]}"
        text = (
            (tmp_path / "rig.toml").read_text().replace("/dev/ttyUSB0", url).replace("/dev/ttyUSB1", url.replace("127.0.0.1", "localhost"))
        )
        (tmp_path / "rig.toml").write_text(text)
        done = rig("sweep", "--cultivar", "RR", check=1)
    assert re.search(r"TransportTimeout: sensor on socket://localhost:\d+: .*no reply", done.stderr)


def test_init_writes_once(rig, tmp_path: Path) -> None:
    rig("init")
    assert "is there already" in rig("init", check=2).stderr
    rig("init", "--force")


def test_cultivars_are_added_and_listed(rig) -> None:
    rig("cultivars", "add", "YR", "--name", "Gold “Strike”", "--colour", "yellow", "--texture", "weak")
    listed = json.loads(rig("cultivars", "list", "--json").stdout)
    assert [c["abbreviation"] for c in listed] == ["BR", "RR", "PR", "WR", "YR"]
    assert listed[-1]["name"] == "Gold “Strike”"
    assert "Black Beauty" in rig("cultivars").stdout
    assert "known already" in rig("cultivars", "add", "YR", "--name", "x", "--colour", "y", check=2).stderr
    assert "rig init" in rig("sweep", "--cultivar", "YR", check=2).stderr


def test_model_eval_knows_other_cells_and_directions(rig) -> None:
    def one(*options: str) -> dict[str, float]:
        (row,) = csv.DictReader(io.StringIO(rig("model", "eval", "--phi", "60", *options).stdout))
        return {name: float(value) for name, value in row.items()}

    papilla = ("--aspect", "1.2", "--p", "1.4", "--q", "1.7", "--gap", "0.1")
    there = one("--mode", "radiometric", "--theta-i", "20", "--theta-r", "50", *papilla)
    back = one("--mode", "radiometric", "--theta-i", "50", "--theta-r", "20", *papilla)
    assert there.pop("theta_r_deg") == 50
    assert back.pop("theta_r_deg") == 20
    assert there == pytest.approx(back)  # reciprocal
    assert list(there) == ["u_diff", "u_spec", "s_diff", "s_spec"]
    assert 0 < there["u_diff"] < there["s_diff"] == pytest.approx(1 / math.pi, rel=1e-5)
    assert one("--theta-r", "50", *papilla)["s_diff"] == pytest.approx(0.5**0.5, rel=1e-5)


def test_model_eval_writes_csv(rig) -> None:
    rows = list(csv.DictReader(io.StringIO(rig("model", "eval", "--mode", "paper", "--theta-i", "45", "--theta-r", "-70:70:10").stdout)))
    assert list(rows[0]) == ["theta_r_deg", "u_diff", "u_spec", "s_diff", "s_spec"]
    assert len(rows) == 15
    assert float(rows[0]["s_diff"]) == pytest.approx(math.cos(math.radians(45)), rel=1e-5)
    mirror = next(row for row in rows if row["theta_r_deg"] == "-40")
    assert float(mirror["s_spec"]) == pytest.approx(math.cos(math.radians(5)) ** 5, rel=1e-5)


def test_a_table_of_others_is_fitted(rig, tmp_path: Path) -> None:
    rows = [f"{t},{40 + 10 * math.cos(math.radians(t))},{lamp}" for lamp in ("on", "off") for t in range(-60, 61, 20)]
    (tmp_path / "t.csv").write_text("# ours\nangle,counts,lamp\n" + "\n".join(rows) + "\n")
    (tmp_path / "t2.csv").write_text("# ours\nangle,counts,lamp,inc\n" + "\n".join(row + ",45" for row in rows) + "\n")
    arguments = (
        "fit",
        "t2.csv",
        "--column",
        "theta_r=angle",
        "--column",
        "value=counts",
        "--column",
        "theta_i=inc",
        "--where",
        "lamp=on",
        "--quantity",
        "intensity",
        "--no-page",
    )
    fitted = json.loads(rig(*arguments, "--json").stdout)
    assert len(fitted["E"]) == 7
    assert fitted["provenance"]["file"] == "t2.csv"
    assert fitted["simulated"] is False
    without_incidence = ("fit", "t.csv", "--column", "theta_r=angle", "--column", "value=counts", "--where", "lamp=on")
    assert "theta_i" in rig(*without_incidence, check=1).stderr
    assert json.loads(rig(*without_incidence, "--theta-i", "45", "--no-page", "--json").stdout)["E"] == fitted["E"]
    (tmp_path / "t3.csv").write_text("theta_i,theta_r,value\n45,0,1\n45,10,nan\n45,20,1\n45,30,1\n45,40,1\n")
    assert re.search(r"t3\.csv.*(line|row|:) ?3", rig("fit", "t3.csv", check=1).stderr)


@pytest.mark.slow
def test_the_leaf_table(rig, shared_data: Path) -> None:
    table = str(shared_data / "leaf" / "principal_plane_dj.csv")
    fitted = json.loads(
        rig(
            "fit",
            table,
            "--theta-r-positive",
            "forward",
            "--where",
            "theta_i_deg=40",
            "--where",
            "wavelength_nm=550",
            "--no-page",
            "--json",
        ).stdout
    )
    assert fitted["E_mean"] > 0
    assert len(fitted["E"]) >= 10
