"""Quantities: one declaration is sampled, written, read, restarted and listed; what it lacks is an
error at once.
"""

import json
from dataclasses import fields, replace

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import Quantity, assembly
from dem_jax.__main__ import main
from dem_jax.contacts import batch_reduction
from dem_jax.dynamics import interleaved_batch
from dem_jax.dynamics.quantity import RESERVED, Axis, format_quantity_table, validate_quantities
from dem_jax.dynamics.standard_quantities import COLLISIONS, QUANTITIES
from dem_jax.errors import RecordError
from dem_jax.io import series
from dem_jax.io.run_files import Run, collect_series
from dem_jax.runner import failure
from dem_jax.scene import Scene
from dem_jax.types import Sample

SIZE = 0.1  # m, half of the floor
FLOOR = [(-SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.0), (SIZE, SIZE, 0.0), (-SIZE, SIZE, 0.0)]
SIDE = [(SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.1), (SIZE, SIZE, 0.1), (SIZE, SIZE, 0.0)]
SAMPLE, EVERY, SHORT, LONG = 3e-5, 10, 40, 90  # s; in samples: between frames, a run, and the run
# that it is part of
JOINED = interleaved_batch.RUNS_AT_ONCE + 1
JOINED_LONG = pytest.param(JOINED, marks=pytest.mark.long)
SIDES = Axis("side", lambda _: 2, lambda _: (("left", 0), ("right", 1)), "SIDE")
# Of scenes that ask for them: test_load_cell, _drive, _collisions, _exchange.
ASKED = ("load_cell", "flap_angle_error", *COLLISIONS, "piece_count", "piece_mass")
KEPT = [quantity for quantity in QUANTITIES if quantity.kept and quantity.name not in ASKED]


def scene(precision="f64", samples=SHORT, **run):
    """Two balls on a floor that shakes, one of them rolling towards a wall."""
    pieces = [
        {
            "position": (0.088, 0.0, 0.0123),
            "velocity": (1.0, 0.1, -0.8),
            "shape": "sphere",
            "radius": 0.012,
        },
        {
            "position": (-0.05, 0.01, 0.0121),
            "velocity": (0.2, 0.0, -0.3),
            "shape": "sphere",
            "radius": 0.012,
        },
    ]
    settings = {
        "precision": precision,
        "sample_interval": SAMPLE,
        "duration": samples * SAMPLE,
        "frame_interval": EVERY * SAMPLE,
    }
    return Scene(
        piece=pieces,
        wall=[{"group": "floor", "corners": FLOOR}, {"group": "side", "corners": SIDE}],
        motion=[
            {
                "group": "floor",
                "stroke": (5e-4, 0.0, 2e-4),
                "frequency": 60.0,
                "vibration_ramp": 1e-3,
            }
        ],
        region=[{"name": "box", "low": (-SIZE, -SIZE, 0.0), "high": (SIZE, SIZE, 0.1)}],
        run=settings | run,
    )


def _velocity(system, state):
    return batch_reduction.split_runs(system, state.velocity)


def _top(system, state):
    return batch_reduction.max_per_run(system, state.position[2])


def _shares(system, state):
    across = batch_reduction.split_runs(system, state.position[0] * system.pieces.mass)
    return jnp.stack(
        [-jnp.sum(jnp.minimum(across, 0), axis=0), jnp.sum(jnp.maximum(across, 0), axis=0)]
    )


OWN = (
    Quantity("velocity", "m/s", ("piece", "xyz"), _velocity, "of each piece"),
    Quantity("top", "m", (), _top, "height of the highest centre"),
    Quantity("moment", "kg m", (SIDES,), _shares, "mass times distance from x = 0, on either side"),
)


def computed(precision, runs, out=None, samples=SHORT, quantities=OWN):
    made = scene(precision, samples)
    if runs is None:
        return dem_jax.simulate(made, out=out, quantities=quantities)
    return dem_jax.ensemble(made, runs=runs, out=out, quantities=quantities)


# --- what follows from a declaration ---


@pytest.mark.parametrize(
    ("runs", "precision"),
    [pytest.param(None, "f32", marks=pytest.mark.long), (2, "f64"), (JOINED, "f32")],
)
def test_every_quantity_is_in_the_file_with_its_unit_and_comes_back(tmp_path, precision, runs):
    run = computed(precision, runs, tmp_path / "run.h5")
    lead = () if runs is None else (runs,)
    names = {
        "force": ("floor", "side"),
        "mean_force": ("floor", "side"),
        "torque": ("floor",),
        "settled_mass": ("box",),
    }
    names |= {
        "energy": ("kinetic", "potential", "elastic", "dissipated", "wall_work", "total"),
        "moment": ("left", "right"),
    }
    dtype, sizes = {"f32": np.float32, "f64": np.float64}[precision], {"xyz": 3, "piece": 2}
    with h5py.File(tmp_path / "run.h5") as file:
        for quantity, stored in zip((*KEPT, *OWN), run.header.quantities, strict=True):
            assert (stored.name, stored.unit, stored.help) == (
                quantity.name,
                quantity.unit,
                quantity.help,
            )
            assert stored.labels == names.get(stored.name, stored.labels)
            along = tuple(sizes[axis] for axis in stored.axes if axis in sizes)
            for path in stored.paths:
                assert file[path].attrs["units"] == quantity.unit, path
                assert file[path].shape == (*lead, SHORT, *along), path
                assert file[path].dtype in (dtype, np.int32), path
        links = h5py.SoftLink  # by former names
        own = {name for name in file if not isinstance(file.get(name, getlink=True), links)}
        assert own == {q.name for q in (*KEPT, *OWN)} | {"time", "pieces", "restart"}
    written = collect_series(run)
    run.save(tmp_path / "again.h5")
    again = dem_jax.load_run(tmp_path / "again.h5")
    held = computed(precision, runs)
    assert again.header == run.header
    for found in (collect_series(again), collect_series(held)):
        assert found.keys() == written.keys()
        for path, array in written.items():
            np.testing.assert_array_equal(found[path], array, err_msg=path)
    for quantity in (*KEPT, *OWN):
        assert getattr(run, quantity.name) is run.series[quantity.name]
    if runs is not None:
        member = run.member(1)
        for path, array in collect_series(member).items():
            np.testing.assert_array_equal(
                array, written[path] if path == "time" else written[path][1], err_msg=path
            )


@pytest.mark.parametrize("runs", [None, 2, JOINED_LONG])
def test_values_are_those_of_the_pieces_at_that_time(runs):
    run = computed("f64", runs)
    at = np.round(run.pieces.time[1:] / SAMPLE).astype(int) - 1
    np.testing.assert_array_equal(
        run.velocity.take(at, axis=-3), run.pieces.velocity[..., 1:, :, :]
    )
    position = run.pieces.position[..., 1:, :, :]
    np.testing.assert_array_equal(run.top.take(at, axis=-1), position[..., 2].max(axis=-1))
    mass = 300 * 4 / 3 * np.pi * 0.012**3
    np.testing.assert_allclose(
        run.moment["right"].take(at, axis=-1),
        mass * np.maximum(position[..., 0], 0).sum(-1),
        rtol=1e-13,
    )
    np.testing.assert_allclose(
        run.moment["left"].take(at, axis=-1),
        -mass * np.minimum(position[..., 0], 0).sum(-1),
        rtol=1e-13,
    )
    assert run.moment["left"].min() > 0.04 * mass and np.ptp(run.moment["right"]) > 0


def test_own_quantities_change_nothing_else():
    plain, more = computed("f64", None, quantities=()), computed("f64", None)
    assert set(collect_series(more)) > set(collect_series(plain))
    for path, array in collect_series(plain).items():
        np.testing.assert_array_equal(collect_series(more)[path], array, err_msg=path)


@pytest.mark.parametrize("runs", [None, JOINED_LONG])
def test_a_resumed_run_goes_on_with_all_quantities(tmp_path, runs):
    path = tmp_path / "run.h5"
    computed("f64", runs, path)
    resumed = dem_jax.resume(path, duration=LONG * SAMPLE, quantities=OWN)
    whole = computed("f64", runs, samples=LONG)
    assert (
        len(resumed.time) == LONG and collect_series(resumed).keys() == collect_series(whole).keys()
    )
    for name, array in collect_series(whole).items():
        np.testing.assert_array_equal(collect_series(resumed)[name], array, err_msg=name)


def test_a_program_is_compiled_for_its_quantities():
    """The same name and axes, another function: not the program of the first."""
    twice = Quantity(
        "top", "m", (), lambda *x: 2 * _top(*x), "twice the height of the highest centre"
    )
    first, second = computed("f64", None), computed("f64", None, quantities=(OWN[0], twice, OWN[2]))
    np.testing.assert_array_equal(second.top, 2 * first.top)


def test_what_the_scene_does_not_have_is_left_out():
    labels = lambda made: {
        stored.name: stored.labels
        for stored in series.declare_quantities(assembly.assemble_system(made).system)
    }
    known, still = labels(scene()), labels(scene(track_energy=False).replace(motion=[], region=[]))
    assert known["energy"] == (
        "kinetic",
        "potential",
        "elastic",
        "dissipated",
        "wall_work",
        "total",
    )
    assert still["energy"] == ("kinetic", "potential", "elastic")
    assert known["torque"] == ("floor",) and still["torque"] == () and still["settled_mass"] == ()
    assert known["max_relative_overlap"] is None


def test_reports_of_several_groups_are_added_up():
    force = QUANTITIES[0]
    system = assembly.assemble_system(dem_jax.load_scene("weigh-bucket")).system
    members = dict(system.walls.reports)["wb_flaps"]
    assert len(members) == 2
    # 4 runs, 7 samples
    values = (
        np.random.default_rng(0).normal(size=(4, 7, 3, len(system.walls.groups))).astype(np.float32)
    )
    found = force.to_datasets(system, values)
    assert set(found) == {name for name, _ in system.walls.reports}
    np.testing.assert_array_equal(
        found["wb_flaps"], values[..., members[0]] + values[..., members[1]]
    )
    assert found["wb_flaps"].dtype == np.float32


def test_what_only_the_driver_reads_is_sampled_but_not_kept():
    system, state = (
        assembly.assemble_system(scene()).system,
        assembly.assemble_system(scene()).state,
    )
    shapes = jax.eval_shape(
        lambda state: Sample({q.name: q.evaluate(system, state) for q in system.quantities}), state
    )
    internal = {"step", "fastest", "stride", "culprit"}
    assert {q.name for q in QUANTITIES if not q.kept} == internal
    for name in internal:
        assert getattr(shapes, name).shape == (1,)
        assert name not in {stored.name for stored in series.declare_quantities(system)}
    with pytest.raises(AttributeError, match="a sample has no 'heat'; it has: .*energy"):
        _ = shapes.heat


def test_quantities_are_listed(capsys):
    assert main(["scenes", "--quantities"]) == 0
    table = capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        main(["run", "--help"])
    assert ended.value.code == 0 and table in capsys.readouterr().out
    every = [quantity for quantity in QUANTITIES if quantity.kept]
    lines = dict(zip([q.name for q in every], table.splitlines(), strict=True))
    for quantity in every:
        row = [part.strip() for part in lines[quantity.name].split("  ") if part]
        assert row == [quantity.name, quantity.unit, quantity.path, quantity.help]
    assert "/force/GROUP " in lines["force"] and "/settled_mass/BLOCK " in lines["settled_mass"]
    assert "/moment/SIDE  mass times distance" in format_quantity_table(OWN)


# --- files ---


def test_a_file_that_does_not_say_what_it_holds_is_read_and_gone_on_with(tmp_path):
    """As files of before were."""
    path = tmp_path / "run.h5"
    run = computed("f64", None, path, quantities=())
    with h5py.File(path, "r+") as file:
        del file.attrs["quantities"]
    old = dem_jax.load_run(path)
    assert old.header.quantities is None
    for name, array in collect_series(run).items():
        np.testing.assert_array_equal(collect_series(old)[name], array, err_msg=name)
    assert len(dem_jax.resume(path, duration=LONG * SAMPLE).energy["total"]) == LONG


def test_a_file_with_fewer_quantities_goes_on_with_those(tmp_path):
    """As files of before a quantity was added."""
    path = tmp_path / "run.h5"
    computed("f64", None, path, quantities=())
    with h5py.File(path, "r+") as file:
        rows = json.loads(file.attrs["quantities"])
        file.attrs["quantities"] = json.dumps([row for row in rows if row["name"] != "momentum"])
        del file["momentum"]
    resumed = dem_jax.resume(path, duration=LONG * SAMPLE)
    assert len(resumed.max_relative_overlap) == LONG
    with pytest.raises(
        AttributeError, match="the run has no 'momentum'; it has: force, mean_force"
    ):
        _ = resumed.momentum


def test_a_file_that_lacks_what_it_says_is_refused(tmp_path):
    path = tmp_path / "run.h5"
    for lost in ("energy/total", "torque/floor", "max_relative_overlap", "moment/left", "top"):
        computed("f64", None, path)
        with h5py.File(path, "r+") as file:
            del file[lost]
        with pytest.raises(RecordError, match=f"run.h5 lacks the dataset '{lost}'"):
            dem_jax.load_run(path)
        path.unlink()


def test_a_run_is_gone_on_with_by_the_quantities_that_it_was_begun_with(tmp_path):
    path = tmp_path / "run.h5"
    computed("f64", None, path, quantities=OWN[1:2])
    before = path.read_bytes()
    grams = replace(OWN[1], unit="mm")
    for given, line in (
        (
            (),
            "run.h5: it holds the quantity 'top', which dem_jax does not know; allowed: with it among quantities",
        ),
        (
            (grams,),
            "run.h5: it holds the quantity 'top' in 'm' along no axis, not in 'mm' along no axis",
        ),
        (
            OWN,
            "run.h5: it does not hold the quantity 'velocity'; allowed: those that the run was begun with",
        ),
    ):
        with pytest.raises(RecordError, match=line):
            dem_jax.resume(path, duration=LONG * SAMPLE, quantities=given)
    assert path.read_bytes() == before


# --- what is refused ---

GOOD = {"name": "top", "unit": "m", "axes": (), "of": _top, "help": "height of the highest centre"}


@pytest.mark.parametrize(
    "wrong, line",
    [
        (
            {"name": "two words"},
            "quantity 'two words': name: allowed: a name as of Python's variables",
        ),
        ({"name": "_hidden"}, "name: allowed"),
        ({"name": ""}, "name: allowed"),
        (
            {"name": "pieces"},
            "quantity 'pieces': name: a run calls something else so; allowed: any but",
        ),
        ({"name": "scene"}, "a run calls something else so"),
        (
            {"unit": ""},
            r"quantity 'top': unit = '': allowed: one line of text \(\"1\": a ratio or a number\)",
        ),
        ({"unit": None}, "quantity 'top': unit = None: allowed: one line of text"),
        ({"help": " "}, "quantity 'top': help = ' ': allowed: one line of text"),
        ({"help": "one\ntwo"}, "allowed: one line of text"),
        ({"of": None}, "quantity 'top': of = None: allowed: a function of system and state"),
        (
            {"axes": ("walls",)},
            "axis 'walls' is unknown; allowed: block, group, moving group, piece, xyz, or an Axis",
        ),
        ({"axes": "xyz"}, "quantity 'top': axis 'x' is unknown"),
        (
            {"axes": ("xyz", "group")},
            "quantity 'top': axes = xyz, group: allowed: rows that have names on the first only",
        ),
        ({"axes": ("group", SIDES)}, "allowed: rows that have names on the first only"),
    ],
)
def test_a_declaration_that_lacks_something_is_one_clear_line(wrong, line):
    with pytest.raises(ValueError, match=line) as caught:
        Quantity(**GOOD | wrong)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lost", ["name", "unit", "axes", "of", "help"])
def test_no_part_may_be_left_out(lost):
    with pytest.raises(TypeError, match=lost):
        Quantity(**{key: value for key, value in GOOD.items() if key != lost})


def test_names_differ():
    with pytest.raises(
        ValueError, match="quantity 'force': there are two of this name; allowed: one"
    ):
        validate_quantities((*QUANTITIES, replace(QUANTITIES[1], name="force")))
    with pytest.raises(ValueError, match="quantity 'energy': there are two of this name"):
        dem_jax.simulate(scene(), quantities=[Quantity(**GOOD | {"name": "energy"})])
    with pytest.raises(ValueError, match="quantities: 'top': allowed: dem_jax.Quantity"):
        dem_jax.simulate(scene(), quantities=["top"])
    double = Axis("side", lambda _: 2, lambda _: (("left", 0), ("left", 1)))
    with pytest.raises(
        ValueError, match="quantity 'top': rows left, left: allowed: names that differ, without /"
    ):
        dem_jax.simulate(scene(), quantities=[Quantity(**GOOD | {"axes": (double,)})])


def test_what_a_run_calls_something_else_is_reserved():
    own = {name for kind in (Run, Sample) for name in dir(kind) if not name.startswith("_")}
    own |= {f.name for kind in (Run, Sample) for f in fields(kind)}
    assert own <= RESERVED


@pytest.mark.parametrize(
    "axes, of, line",
    [
        (
            ("xyz",),
            _top,
            r"quantity 'own': its function gave the form \(1,\); allowed: 3 \(xyz\), 1 \(run\)",
        ),
        (
            ("group", "xyz"),
            lambda system, state: state.walls.force[0],
            r"form \(2, 1\); allowed: 3 \(xyz\), 2 \(group\), 1",
        ),
        (
            (),
            lambda system, state: jnp.max(state.position[2]),
            r"gave the form \(\); allowed: 1 \(run\); contacts.batch_reduction has sums",
        ),
    ],
)
def test_a_function_that_does_not_fit_its_axes_is_refused_before_anything_runs(
    tmp_path, axes, of, line
):
    own = Quantity("own", "m", axes, of, "does not fit")
    for runs in (None, JOINED):
        with pytest.raises(
            ValueError, match=line if runs is None else "quantity 'own': its function gave the form"
        ):
            computed("f64", runs, tmp_path / "run.h5", quantities=(own,))
        assert not any(tmp_path.iterdir())


def test_an_error_in_a_function_says_in_which():
    own = Quantity("own", "m", (), lambda system, state: state.height, "of nothing")
    with pytest.raises(AttributeError, match="height") as caught:
        computed("f64", None, quantities=(own,))
    assert "in the function of the quantity 'own'" in caught.value.__notes__


def test_a_quantity_of_ones_own_that_is_not_finite_stops_a_run():
    fine = {"culprit": np.full((1, 4), -1), "count": np.zeros((1, 4), np.int32)}
    fine |= {name: np.zeros((1, 4)) for name in ("max_relative_overlap", "stride")}
    samples = Sample(fine | {"own": np.array([[1.0, 2.0, np.nan, np.nan]])})
    assert (
        failure.detect_failure(samples, 4) == (0, 2) and failure.detect_failure(samples, 2) is None
    )
    line = failure._describe_nonfinite(None, jax.tree.map(lambda x: x[0], samples), 2, 0.1, 0)
    assert line.startswith(
        "at t = 0.1 s: the quantity 'own' is not finite, while all else is; likely cause: its own function"
    )


# --- one by one ---


@pytest.mark.parametrize("runs", [None, JOINED_LONG])
def test_contacts_are_those_that_the_poses_show(runs):
    """Spheres: a contact is a distance below that of touch. The floor rests here; two balls meet on
    it, one hits a wall.
    """
    radius = 0.012
    pieces = [
        {"position": (x, 0.0, z), "velocity": (v, 0.0, -0.1), "shape": "sphere", "radius": radius}
        for x, z, v in (
            (0.086, 0.0122, 0.5),
            (0.0, 0.0121, 0.4),
            (0.0252, 0.0123, -0.4),
            (-0.05, 0.05, 0.0),
        )
    ]
    made = scene(samples=300, frame_interval=SAMPLE).replace(motion=[], piece=pieces)
    run = dem_jax.simulate(made) if runs is None else dem_jax.ensemble(made, runs=runs)
    position = run.pieces.position[..., 1:, :, :]
    first, second = np.triu_indices(4, 1)
    apart = np.linalg.norm(position[..., first, :] - position[..., second, :], axis=-1)
    wanted = {
        "floor": (position[..., 2] < radius).sum(axis=-1),
        "side": (SIZE - position[..., 0] < radius).sum(axis=-1),
        "between_pieces": (apart < 2 * radius).sum(axis=-1),
    }
    assert run.contact_count.keys() == wanted.keys()
    for name, count in wanted.items():
        np.testing.assert_array_equal(run.contact_count[name], count, err_msg=name)
    most = {name: count.max() for name, count in wanted.items()}
    assert most == {"floor": 3, "side": 1, "between_pieces": 1} and all(
        count.min() == 0 for count in wanted.values()
    )


def test_parts_of_pieces_are_no_walls_among_the_contacts():
    two = [{"shape": "sphere", "radius": 0.01, "position": (x, 0.0, 0.0)} for x in (-0.008, 0.008)]
    piece = {"shape": "compound", "part": two}
    built = assembly.assemble_system(
        scene().replace(piece=[piece | {"position": (0.0, 0.0, z)} for z in (0.02, 0.05)])
    )
    system, state = built.system, built.state
    assert system.parts.count == 4

    def touching(kind, a, b):
        table = state.contacts[kind]
        memory = table.memory.replace(overlap=table.memory.overlap.at[0].set(1e-4))
        return table.replace(a=table.a.at[0].set(a), b=table.b.at[0].set(b), memory=memory)

    # the second panel
    tables = {"spheres": touching("spheres", 2, 0), "plates": touching("plates", 4 + 1, 3)}
    (found,) = (
        q.evaluate(system, state.replace(contacts=state.contacts | tables))
        for q in QUANTITIES
        if q.name == "contact_count"
    )
    assert found[:, 0].tolist() == [0, 1, 1]  # floor, side, between pieces
