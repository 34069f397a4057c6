"""The commands that list, check and export, and the former names of commands."""

import pytest

from dem_jax.cli.main import COMMANDS, build_parser, main
from tests.dem_jax.stored import stored


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stored().save("two.h5")
    return "two.h5"


def printed(capsys, *words):
    assert main(list(words)) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def refused(capsys, *words):
    assert main(list(words)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("former", "now"),
    [
        (["scenes"], ["list", "scenes"]),
        (["scenes", "plate-drop"], ["check", "plate-drop"]),
        (["scenes", "--quantities"], ["list", "quantities"]),
        (["products", "hazelnut"], ["list", "products", "hazelnut"]),
        (["buckets", "2.9-litre"], ["list", "buckets", "2.9-litre"]),
    ],
)
def test_a_former_command_prints_what_the_one_of_now_prints(former, now, capsys):
    assert printed(capsys, *former) == printed(capsys, *now) != ""


def test_the_help_lists_the_commands_of_now_only(capsys):
    with pytest.raises(SystemExit):
        build_parser().parse_args(["--help"])
    listed = [
        line.split()[0]
        for line in capsys.readouterr().out.splitlines()
        if line[:4] == " " * 4 and line[4:5] != " "
    ]
    assert len(listed) == len(COMMANDS)
    assert {"list", "check", "export"} <= set(listed)
    assert not {"scenes", "products", "buckets", "render", "gltf", "vtk"} & set(listed)


def test_list_names_all_that_there_is(capsys):
    out = printed(capsys, "list")
    for kind, name in {
        "scenes": "weigh-bucket",
        "products": "hazelnut",
        "buckets": "2.9-litre",
        "studies": "softening",
    }.items():
        (line,) = [line for line in out.splitlines() if line.startswith(kind)]
        assert name in line
        assert name in printed(capsys, "list", kind)


def test_a_name_that_list_cannot_show_is_refused_with_what_does(capsys):
    assert "dem-jax check" in refused(capsys, "list", "scenes", "weigh-bucket")
    assert "dem-jax study NAME" in refused(capsys, "list", "studies", "softening")


@pytest.mark.parametrize("ending", ["csv", "xlsx", "glb", "gif", "png"])
def test_the_format_is_that_of_to_or_of_the_ending(ending, file, tmp_path, capsys):
    default = tmp_path / ("two-scene.png" if ending == "png" else f"two.{ending}")
    assert default.name in printed(capsys, "export", file, "--to", ending)
    printed(capsys, "export", file, "--out", f"other.{ending}")
    size = default.stat().st_size
    assert (tmp_path / f"other.{ending}").stat().st_size == pytest.approx(size, abs=64)  # dates


def test_paraview_files_are_the_same_by_either_command(file, tmp_path, capsys):
    printed(capsys, "export", file, "--to", "vtk", "--out", "now")
    printed(capsys, "vtk", file, "--out", "former")
    now, former = (
        sorted(p.relative_to(tmp_path / f) for p in (tmp_path / f).rglob("*.vtp"))
        for f in ("now", "former")
    )
    assert now == former != []


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--out", "x.doc"], "--out x.doc must end in one of: .csv, .xlsx"),
        (["--out", "x.csv", "--to", "gif"], "allowed with --to gif: a name that ends in .gif"),
        (["--to", "csv", "--at", "0.1"], "csv has no instants"),
        (["--to", "csv", "--run", "1"], "--run 1: tables have all runs"),
    ],
)
def test_what_a_format_cannot_do_is_refused(words, part, file, capsys):
    assert part in refused(capsys, "export", file, *words)


def test_wall_impacts_are_of_one_file(file, capsys):
    assert "2 files" in refused(capsys, "plot", file, file, "--wall-impacts")
    assert "statistics" in refused(capsys, "plot", file, "--wall-impacts")


def test_a_study_is_reweighted_by_files(capsys):
    assert "study reweight: no file" in refused(capsys, "study", "reweight")
    assert "none.h5" in refused(capsys, "study", "reweight", "none.h5")
