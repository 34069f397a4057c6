"""Files and the command line: layouts that others read, one clear line on bad input, nothing
overwritten unasked.
"""

import tomllib
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from product_model import BadInput, ensemble, load, parameters, simulate
from product_model.__main__ import main

SHORT = ["simulate", "--sample", "1e-3", "--duration", "0.3"]


def test_hdf5_has_the_layout_of_the_discrete_element_runs(capsys):
    assert main([*SHORT, "--runs", "4", "--seed", "3", "--out", "t.h5"]) == 0
    assert "4 portion(s) of 9 pieces" in capsys.readouterr().out
    with h5py.File("t.h5") as file:
        assert file["time"].shape == (300,) and file["force/wb_flaps"].shape == (4, 300, 3)
        assert file["mean_force/wb_flaps"].shape == (4, 300, 3) and file[
            "settled_mass/wb"
        ].shape == (4, 300)
        datasets = []
        file.visititems(
            lambda name, item: datasets.append(item) if isinstance(item, h5py.Dataset) else None
        )
        assert all("units" in item.attrs for item in datasets)
        np.testing.assert_allclose(file["mean_force/wb_flaps"][:, -1, 2], -9 * 5.832e-3 * 9.81)
        scene = tomllib.loads(file.attrs["scene"])
    assert scene["portion"] == {"count": 9, "piece_mass": 5.832e-3, "target_weight": 0.05}
    assert scene["product_model"]["gamma_high"] == 0.06


def test_one_run_has_no_run_axis_and_equals_the_python_call():
    import jax

    assert main([*SHORT, "--seed", "3"]) == 0
    data = load("trace.h5")
    expected = simulate(
        parameters(sample=1e-3, duration=0.3), jax.random.split(jax.random.key(3), 1)[0]
    )
    np.testing.assert_allclose(
        -data["mean_force/wb_flaps"][:, 2], expected.force, rtol=1e-12, atol=1e-12
    )


def test_csv_and_mat_hold_the_same_numbers():
    for name in ("t.h5", "t.csv", "t.mat"):
        assert main([*SHORT, "--runs", "2", "--out", name]) == 0
    force = -load("t.h5")["mean_force/wb_flaps"][..., 2]
    with open("t.csv") as file:
        assert file.readline().strip() == "time_s,force_n_0001,pif_g_0001,force_n_0002,pif_g_0002"
    table = np.loadtxt("t.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, [1, 3]].T, force, rtol=1e-8, atol=1e-8)  # nine digits are
    # written
    mat = loadmat("t.mat")
    np.testing.assert_array_equal(mat["force_n"], force)
    assert mat["inputs"]["h_mean"][0, 0].item() == 0.25


def test_a_mat_file_has_the_documented_arrays():
    for runs, shape in (("1", (300, 1)), ("2", (2, 300))):
        assert main([*SHORT, "--runs", runs, "--out", f"{runs}.mat"]) == 0
        mat = {
            name: value
            for name, value in loadmat(f"{runs}.mat").items()
            if not name.startswith("__")
        }
        assert mat.keys() == {"time_s", "force_n", "pif_g", "settled_mass_kg", "inputs"}
        assert mat["time_s"].shape == (300, 1)
        assert {mat[name].shape for name in ("force_n", "pif_g", "settled_mass_kg")} == {shape}


def test_portions_in_blocks_make_the_same_file(monkeypatch, capsys):
    monkeypatch.setattr("product_model.__main__.BLOCK_BYTES", 70_000)  # two portions
    assert main([*SHORT, "--runs", "4", "--out", "blocks.h5", "--plot", "blocks.png"]) == 0
    in_blocks, said = capsys.readouterr()
    monkeypatch.setattr("product_model.__main__.BLOCK_BYTES", 2**28)
    assert main([*SHORT, "--runs", "4", "--out", "whole.h5"]) == 0
    assert in_blocks.replace("blocks.h5, blocks.png", "whole.h5") == capsys.readouterr().out
    assert (
        "the figure is that of the first 2 portions" in said
        and Path("blocks.png").stat().st_size > 0
    )
    blocks, whole = load("blocks.h5"), load("whole.h5")
    assert blocks.keys() == whole.keys() and blocks.pop("attrs") == whole.pop("attrs")
    for name, values in whole.items():
        np.testing.assert_allclose(blocks[name], values, rtol=1e-13, atol=1e-13, err_msg=name)
        assert blocks[name].dtype == values.dtype


def test_what_does_not_fit_is_refused_before_it_is_computed(monkeypatch, capsys):
    monkeypatch.setattr("product_model.memory.available_memory", lambda: 100_000_000)
    assert main(["simulate", "--runs", "10000", "--out", "t.mat"]) == 2
    error = capsys.readouterr().err  # 12 numbers for each of 10886 samples and 20 for each of 9
    # pieces, 8 bytes each
    assert "runs = 10000: needs 10.5 GB of memory, and 0.1 GB are available; write to .h5" in error
    with pytest.raises(
        BadInput,
        match="runs = 10000: needs 3.5 GB of memory, and 0.1 GB are available; use ensemble_blocks",
    ):
        ensemble(parameters(), 0, 10000)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=50_000))
    monkeypatch.setattr("product_model.__main__.BLOCK_BYTES", 70_000)
    assert main([*SHORT, "--runs", "8", "--out", "t.h5"]) == 2
    assert (
        "out = t.h5: needs 0.0 GB, and 0.0 GB are free; give a larger --sample"
        in capsys.readouterr().err
    )
    assert not list(Path().iterdir())


def test_a_note_says_how_large_a_file_becomes(monkeypatch, capsys):
    """It stops at the disk, which is full here."""
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=0))
    monkeypatch.setattr("product_model.__main__.BLOCK_BYTES", 70_000)
    assert main([*SHORT, "--runs", "100000", "--out", "t.h5"]) == 2
    assert "note: 100000 portions of 300 samples make a file of 1.9 GB" in capsys.readouterr().err


def test_a_figure_is_drawn_for_one_and_for_many():
    assert main([*SHORT, "--plot", "one.png"]) == 0
    assert main([*SHORT, "--plot", "many.png", "--runs", "5", "--out", "many.h5"]) == 0
    for name in ("one.png", "many.png"):
        with open(name, "rb") as file:
            assert file.read(8) == b"\x89PNG\r\n\x1a\n"


BAD = {
    "negative height": (["--h-mean", "-1"], "h_mean = -1.0: must be greater than 0 (m)"),
    "negative mass": (["--m-piece", "-1"], "m_piece = -1.0: must be greater than 0 (kg)"),
    "not a number": (["--dt-impact", "nan"], "dt_impact"),
    "infinite": (["--m-target", "inf"], "m_target = inf: must be finite"),
    "limits in the wrong order": (
        ["--gamma-high", "0.01"],
        "gamma_high = 0.01 m: must be at least gamma_low = 0.02 m",
    ),
    "no pieces": (["--pieces", "0"], "pieces = 0: must be greater than or equal to 1"),
    "no runs": (["--runs", "0"], "runs = 0: must be at least 1"),
    "suffix": (["--out", "t.txt"], "out = t.txt: must end in one of .h5, .hdf5, .csv, .mat"),
    "folder": (["--out", "nowhere/t.h5"], "out = nowhere/t.h5: the folder does not exist"),
    "figure": (["--plot", "t.txt"], "plot = t.txt: must end in .png, .pdf or .svg"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_clear_line(case, capsys):
    arguments, message = BAD[case]
    assert main([*SHORT, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_unknown_words_are_one_clear_line(capsys):
    for arguments in (
        ["simulate", "--h-mean", "high"],
        ["simulate", "--colour", "red"],
        ["dance"],
        ["simulate", "--form", "round"],
    ):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_a_bit_that_flips_is_found():
    assert main(SHORT) == 0
    with h5py.File("trace.h5") as file:
        where = file["pif"].id.get_chunk_info(0).byte_offset
    content = bytearray(Path("trace.h5").read_bytes())
    content[where + 5] ^= 16
    Path("trace.h5").write_bytes(content)
    with pytest.raises(BadInput, match=r"trace\.h5: not a readable HDF5 file"):
        load("trace.h5")


def test_nothing_is_overwritten_unasked(capsys):
    assert main(SHORT) == 0
    before = load("trace.h5")["pif"]
    assert main([*SHORT, "--seed", "1"]) == 2
    assert (
        "out = trace.h5: exists; give another name, or --overwrite to replace it"
        in capsys.readouterr().err
    )
    np.testing.assert_array_equal(load("trace.h5")["pif"], before)
    assert main([*SHORT, "--seed", "1", "--force"]) == 0
    assert not np.array_equal(load("trace.h5")["pif"], before)
    assert main([*SHORT, "--seed", "2", "--overwrite"]) == 0


def test_table_names_every_default_and_its_source(capsys):
    assert main(["table"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    names = {row.split(" | ")[0].strip("| ") for row in rows}
    assert {
        "m_target",
        "m_piece",
        "dt_impact",
        "sample",
        "h_mean",
        "gamma_low",
        "gamma_high",
        "force",
    } <= names
    assert all(row.rstrip(" |").rsplit(" | ", 1)[-1].strip() for row in rows)
