"""What compiles anew and what does not, and how XLA is asked to compile."""

import os
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import assembly, program_store, xla_flags
from dem_jax.broad_phase import neighbour_list, overflow_recovery
from dem_jax.contact_laws.linear_dashpot import LinearDashpot
from dem_jax.contacts import tiling
from dem_jax.dynamics import stepping
from dem_jax.math import vector
from dem_jax.runner import programs
from dem_jax.runner.interface import simulate
from dem_jax.runner.job_setup import choose_slot_block
from dem_jax.scene import load_scene
from dem_jax.types import pytree

BASE = {
    "run.duration": 6e-4,
    "portion.settling_time": 6e-4,
    "portion.count": 3,
    "run.sizes": "classes",
}

# Key and value, and whether the time step stays what it was.
SAME_PROGRAM = {
    "seed": {},
    "drop height": {"drop.height": 0.4},
    "density": {"material.density": 250.0},
    "restitution and its time step": {"material.restitution": 0.3},
    "softening and its time step": {"material.numerical_softening": 0.02},
    "friction": {"material.friction_piece": 0.5},
    "flap timing": {"feed_bucket.opening_time": 0.1, "feed_bucket.opening_start": 0.01},
    "sample interval": {"run.sample_interval": 6e-5},
    "duration": {"run.duration": 1.2e-3},
    "count": {"portion.count": 4},
}


@pytest.fixture
def traces(monkeypatch):
    """Counts how often a step is traced."""
    count = []
    advance = stepping.advance_step
    monkeypatch.setattr(stepping, "advance_step", lambda *args: count.append(1) or advance(*args))
    monkeypatch.setattr(programs, "EXECUTABLES", {})
    return count


def test_other_values_do_not_compile_anew(traces):
    def go(changes, seed=0):
        scene = load_scene("quick-release").replace(BASE | changes)
        return simulate(scene, seed=seed)

    go({})
    first = len(traces)
    assert first > 0 and len(programs.EXECUTABLES) == 1
    for name, changes in SAME_PROGRAM.items():
        result = go(changes, seed=1)
        assert np.isfinite(result.energy["kinetic"]).all()
        assert len(traces) == first and len(programs.EXECUTABLES) == 1, name
    go({"run.sizes": "exact"})
    assert len(traces) == 2 * first  # numbers of pieces and slots are part of it: the test can fail


@pytree
class LawOfAUser(LinearDashpot):
    """A law that is not of dem_jax."""


def test_a_stored_program_is_found_without_tracing(traces, tmp_path):
    piece = {"shape": "sphere", "radius": 0.01, "position": [0, 0, 0.0105], "velocity": [0, 0, -1]}
    scene = load_scene("plate-drop").replace({"piece": [piece], "run.duration": 3e-3})
    store = tmp_path / "store"

    def go(law=None):
        programs.EXECUTABLES.clear()
        before = len(traces)
        return simulate(scene, law=law), len(traces) - before

    plain, traced = go()
    program_store.use_folder(store)
    made, again = go()
    read, none = go()
    assert traced == again > 0 == none
    assert plain.force["plate"].any()
    for run in (made, read):
        assert np.array_equal(plain.force["plate"], run.force["plate"])
        assert np.array_equal(plain.energy["total"], run.energy["total"])
    (file,) = store.glob("program-*")
    file.write_bytes(file.read_bytes()[:1000])  # as of a process that was killed
    assert go()[1] == traced
    assert go()[1] == 0
    law = LawOfAUser(np.float64(1.0))
    assert go(law)[1] == go(law)[1] > 0  # its code is not among what the name of a file says
    assert len(list(store.glob("program-*"))) == 1


def test_the_search_for_contacts_is_traced_once(monkeypatch):
    """For the first state and for the program of its run."""
    count = []
    find = neighbour_list.match_contacts
    monkeypatch.setattr(
        neighbour_list, "match_contacts", lambda *args: count.append(1) or find(*args)
    )
    monkeypatch.setattr(programs, "EXECUTABLES", {})
    neighbour_list._search_contacts.clear_cache()
    simulate(load_scene("plate-drop").replace({"run.duration": 1e-3}))
    assert len(count) == 1  # of one kind of contact


def test_flags_of_the_person_are_left_alone(monkeypatch):
    mine = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=7"
    monkeypatch.setenv("XLA_FLAGS", mine)
    xla_flags.set_loop_flags()
    assert os.environ["XLA_FLAGS"] == mine
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    monkeypatch.setattr(xla_flags, "is_xla_in_use", lambda: False)
    xla_flags.set_loop_flags()
    xla_flags.set_loop_flags(unrolled=True)  # the first call decides
    assert (
        os.environ["XLA_FLAGS"]
        == f"--xla_cpu_enable_fast_math=false {xla_flags.LOOP_FLAGS},{xla_flags.NO_PARTIAL_UNROLLING}"
    )


def test_of_an_ensemble_loops_are_unrolled():
    program = (
        "import os, sys; from dem_jax.runner.job_setup import prepare_job\n"
        "prepare_job('quick-release', [0], 1 if sys.argv[1] == 'ensemble' else None)\n"
        "print(os.environ['XLA_FLAGS'])"
    )
    settings = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    settings["PYTHONPATH"] = os.pathsep.join(sys.path)
    said = {}
    for which in ("ensemble", "run"):
        done = subprocess.run(
            [sys.executable, "-c", program, which], env=settings, capture_output=True, text=True
        )
        assert not done.returncode and "Warning" not in done.stderr, done.stderr
        said[which] = done.stdout.strip()
    assert said == {
        "ensemble": xla_flags.LOOP_FLAGS,
        "run": f"{xla_flags.LOOP_FLAGS},{xla_flags.NO_PARTIAL_UNROLLING}",
    }


def test_a_warning_says_that_it_is_too_late_to_make_one_function_of_each_loop(monkeypatch):
    jnp.ones(()).block_until_ready()
    xla_flags.set_loop_flags()  # said in time, by conftest.py
    monkeypatch.setenv("XLA_FLAGS", "")
    with pytest.warns(
        RuntimeWarning,
        match=r"two to three times as long.* call dem_jax.xla_flags.set_loop_flags\(\) before",
    ):
        xla_flags.set_loop_flags()


def test_whether_jax_is_in_use_is_known_and_changes_nothing():
    program = (
        "import os, jax; from dem_jax import xla_flags\n"
        "print(xla_flags.is_xla_in_use(), xla_flags.is_xla_in_use(), len(jax.devices()), xla_flags.is_xla_in_use())"
    )
    settings = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "JAX_NUM_CPU_DEVICES": "3"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=settings, capture_output=True, text=True
    )
    assert done.stdout.split() == ["False", "False", "3", "True"], done.stderr
    devices = jax.config.jax_num_cpu_devices
    jnp.ones(()).block_until_ready()
    assert xla_flags.is_xla_in_use() and jax.config.jax_num_cpu_devices == devices


# options that a version has no more
GONE = {"xla_cpu_use_fusion_emitters"} if jax.__version_info__ >= (0, 11) else set()


def test_every_option_is_known_to_the_compiler():
    """To those of all versions that are supported: one that a new version lacks shows here."""
    rest = {
        name: value for name, value in xla_flags.BACKEND_OPTIONS["cpu"].items() if name not in GONE
    }
    assert xla_flags.supported_options("cpu") == rest
    assert (
        xla_flags.supported_options("cpu", light=True)
        == rest | xla_flags.FAST_COMPILE_OPTIONS["cpu"]
    )
    compiled = xla_flags.jit_for_backend(lambda x: x + 1, "cpu")
    assert float(compiled(jnp.ones(()))) == 2.0


@pytest.mark.skipif(
    jax.__version_info__[:2] != (0, 10),
    reason="counted with jax 0.10; other versions fuse otherwise",
)
def test_what_is_left_to_compile_does_not_grow_unseen(tmp_path):
    """The stock drop is 60 000 instructions of LLVM's. Where a kernel has several sums over rows,
    XLA writes all that comes before anew for each: with one such kernel it was 90 000, and took 2.5
    times as long to compile.
    """
    program = (
        "from dem_jax import load_scene, simulate\n"
        "short = {'run.duration': 6e-4, 'portion.settling_time': 6e-4}\n"
        "simulate(load_scene('weigh-bucket', short))"
    )
    flags = f"--xla_dump_to={tmp_path} --xla_dump_hlo_module_re=.*_chunk.*"
    settings = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_ENABLE_COMPILATION_CACHE": "0",
        "XLA_FLAGS": flags,
    }
    done = subprocess.run(
        [sys.executable, "-c", program], env=settings, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr
    written = [file.read_text() for file in tmp_path.glob("*ir-no-opt.ll")]
    assert 40_000 < sum(len(re.findall(r"^  ", text, re.MULTILINE)) for text in written) < 75_000


@pytest.mark.parametrize(
    "name, changes, light",
    [
        ("plate-drop", {}, True),
        ("weigh-bucket", {}, True),
        ("weigh-bucket", {"portion.scale_factor": 0.3}, False),
        ("weigh-bucket", {"product": "almond", "portion.count": 20}, True),
        ("weigh-bucket", {"product": "almond"}, True),
        ("weigh-bucket", {"product": "coffee-bean"}, False),
    ],
)
def test_single_runs_of_few_slots_are_compiled_lightly(name, changes, light):
    """Their steps are nearly as fast so, and the others slower."""
    built = assembly.assemble_system(load_scene(name).replace({"run.precision": "f32"} | changes))
    assert programs.needs_fast_compile(built.system) is light


def test_lightly_compiled_steps_have_the_same_bits(monkeypatch):
    scene = load_scene("plate-drop")
    runs = []
    for slots in (programs.FAST_COMPILE_SLOTS, 0):
        monkeypatch.setattr(programs, "FAST_COMPILE_SLOTS", slots)
        monkeypatch.setattr(programs, "EXECUTABLES", {})
        runs.append(simulate(scene))
    one, other = runs
    assert one.force["plate"].any()
    for name in one.force:
        np.testing.assert_array_equal(one.force[name], other.force[name])


def test_options_that_the_compiler_does_not_have_are_not_asked_for(monkeypatch):
    wanted = xla_flags.BACKEND_OPTIONS["cpu"]
    monkeypatch.setitem(
        xla_flags.BACKEND_OPTIONS, "cpu", wanted | {"xla_cpu_of_another_version": True}
    )
    assert xla_flags.supported_options("cpu") == {
        name: value for name, value in wanted.items() if name not in GONE
    }
    compiled = xla_flags.jit_for_backend(lambda x: x + 2, "cpu")
    assert float(compiled(jnp.ones(()))) == 3.0
    assert xla_flags.supported_options("another") == {}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_kept_is_the_same_to_the_last_bit(dtype):
    info = np.finfo(dtype)
    hard = [0.0, -0.0, 1 / 3, -1.0, np.inf, -np.inf, info.max, -info.tiny, np.nan]
    x = np.concatenate(
        [np.array(hard, dtype), np.random.default_rng(0).normal(size=100).astype(dtype)]
    )
    unsigned = {np.float32: np.uint32, np.float64: np.uint64}[dtype]
    for kept in (vector.fusion_barrier, jax.jit(vector.fusion_barrier)):
        np.testing.assert_array_equal(
            np.asarray(kept(jnp.asarray(x))).view(unsigned), x.view(unsigned)
        )
    for gradient in (
        jax.grad(lambda x: 3 * vector.fusion_barrier(x)),
        jax.jacfwd(lambda x: 3 * vector.fusion_barrier(x)),
    ):
        assert float(gradient(jnp.asarray(0.7, dtype))) == 3


def test_whole_numbers_that_are_kept_are_the_same():
    info = np.iinfo(np.int32)
    x = jnp.asarray([0, 1, -1, 7, info.max, info.min], jnp.int32)
    for kept in (vector.fusion_barrier, jax.jit(vector.fusion_barrier)):
        np.testing.assert_array_equal(kept(x), x)


def test_what_is_kept_is_computed_once_by_the_compiled_program():
    # A kernel of its own, beside the one that uses it three times.
    def three(kept, a, b):
        x = kept(a * b + a)
        return jnp.stack([2 * x + b, x * x * b, x - b])

    def kernels(kept):
        ones = jnp.ones(64)
        text = (
            xla_flags.jit_for_backend(lambda a, b: three(kept, a, b), "cpu")
            .lower(ones, ones)
            .compile()
            .as_text()
        )
        return text.count("kind=kLoop")

    assert kernels(vector.fusion_barrier) == kernels(lambda x: x) + 1


def test_loads_of_contacts_are_not_padded_by_the_compiled_program():
    # Padding reads on, masked, past the end of what is padded: several times the time of a step if
    # those pages are unused.
    scene = load_scene("quick-release").replace(BASE)
    built = assembly.assemble_system(scene, 0)
    rows = 2 * sum(slots for *_, slots in built.system.capacity) + 1
    text = (
        xla_flags.jit_for_backend(stepping.advance_step, "cpu")
        .lower(built.system, built.state)
        .compile()
        .as_text()
    )
    assert f"f32[7,{rows}]" in text
    assert not re.search(rf"f32\[7,{rows}\]\S* pad\(", text)


@pytest.mark.parametrize(
    "shape", [{}, {"portion.shape": "sphere", "portion.radius": 0.01}], ids=["polytopes", "spheres"]
)
def test_a_step_writes_over_history_and_loads(shape):
    """Else 28 MB would be copied in each step of 50 000 spheres."""
    built = assembly.assemble_system(load_scene("quick-release").replace(BASE | shape), 0)
    rooms = {kind: 1024 + 64 * k for k, (kind, *_) in enumerate(built.system.capacity)}
    capacity = tuple((kind, near, rooms[kind]) for kind, near, _ in built.system.capacity)
    system, state = overflow_recovery.with_capacity(
        built.system, built.state, capacity, built.system.touching, 1
    )
    system = system.replace(slot_block=choose_slot_block())
    assert all(tiling.tile_size(system, kind, room) for kind, room in rooms.items())
    steps = lambda system, state: jax.lax.fori_loop(
        0, 9, lambda _, state: stepping.advance_step(system, state), state
    )
    text = xla_flags.jit_for_backend(steps, "cpu").lower(system, state).compile().as_text()
    loop, entry = text.split("\nENTRY ")
    sizes = "|".join(map(str, [*rooms.values(), 2 * sum(rooms.values()) + 1]))
    copies = rf"(f32|s32)\[(\d,)?({sizes})\]\S* copy\("
    assert re.search(copies, entry), "of what the caller keeps"
    assert not re.findall(copies, loop)
