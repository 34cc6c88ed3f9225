"""Backends: a strict fake of a GPU everywhere, the real CuPy where it is installed, a real GPU where there is one."""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh, fourier_transform
from sobolev_batch.errors import BackendError, InputError
from sobolev_batch.norms.fields import compute_field, field_for
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.transform import backends, exact, kinds
from sobolev_batch.transform.backends import CPU, Gpu, backend_named, gpu_backend, try_out
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.fourier import ErrorTarget, Execution, Transformed, TransformSettings, transform_block
from sobolev_batch.transform.lattice import Block, FrequencyLattice, OctaveLattice
from sobolev_batch.transform.nufft_costs import GPU_COSTS
from sobolev_batch.transform.quadrature import assign_rules, merged_edges
from sobolev_batch.transform.rules import sharing_rule
from tests.support.fake_device import FUNCTIONS, OPTIONS, UFUNCS, Array, CUDARuntimeError, Device, device_of

LATTICE = Lattice(5.0, 32)
DOUBLE = TransformSettings(1e-13)
ROUGH = TransformSettings(1e-9)


def uneven() -> Mesh:
    """A closed surface with triangles of all sizes: corners, midpoints, interior rules and triangles cut up."""
    sphere = icosphere(3)
    height = sphere.vertices[:, 2]
    stretched = sphere.vertices * (0.5 + 0.4 * np.sin(sphere.vertices @ np.array([3.0, -2.0, 1.0])))[:, None]
    small = np.where(height[:, None] > 0.2, stretched, 0.02 * stretched + np.array([0.0, 0.0, -0.3]))
    far = Mesh(np.array([[-1.2, -1.2, 0.9], [1.3, -1.1, 0.8], [0.1, 1.4, 1.2]]), [[0, 1, 2]])
    return Mesh(np.concatenate([small, far.vertices]), np.concatenate([sphere.triangles, far.triangles + len(small)]))


MESHES = {"icosphere 0": icosphere(0), "icosphere 3": icosphere(3), "uneven": uneven()}


def on(backend: backends.Backend, mesh: Mesh, settings: TransformSettings = DOUBLE, **options: Any) -> Transformed:
    return transform_block(mesh, LATTICE, LATTICE.half, settings, Execution(backend, **options))


def assert_agree(found: Transformed, expected: Transformed, mesh: Mesh, tolerance: float = 1e-12) -> None:
    assert (found.backend, expected.backend) == ("cufinufft", "finufft")
    assert found.points == expected.points
    assert found.values.dtype == expected.values.dtype
    assert isinstance(found.values, np.ndarray)
    assert np.abs(found.values - expected.values).max() < tolerance * mesh.area


SETTINGS = [
    *((TransformSettings(1e-13, quadrature=quadrature), 1e-12) for quadrature in ("auto", "gauss8", 7)),
    (TransformSettings(1e-13, tolerance=1e-2), 1e-12),
    (TransformSettings(1e-6, "complex64"), 1e-5),
]


@pytest.fixture(scope="module")
def gpu() -> Gpu:
    return device_of("gpu")


@pytest.mark.parametrize("device", ["fake", "gpu"])
@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize(("settings", "tolerance"), SETTINGS)
def test_a_gpu_agrees_with_the_processor(device: str, name: str, settings: TransformSettings, tolerance: float) -> None:
    backend = device_of(device)
    assert_agree(on(backend, MESHES[name], settings), on(CPU, MESHES[name], settings), MESHES[name], tolerance)


def test_the_uneven_mesh_has_every_kind_of_rule() -> None:
    kinds = {sharing_rule(1): "corners", sharing_rule(2): "midpoints"}
    uses = assign_rules(uneven(), LATTICE.highest_frequency, 1e-2)
    found = {"split" if use.splits else kinds.get(use.rule, "interior") for use in uses}
    assert found == {"corners", "midpoints", "interior", "split"}


@pytest.mark.parametrize(
    ("lattice", "block"),
    [
        (LATTICE, Block((-3, 4, 2), (5, 2, 4))),
        (LATTICE, Block((-2, -3, 0), (4, 6, 1))),
        # Turned and shifted, with a period far below the size of the mesh.
        (OctaveLattice.random(8.0, 32.0, 16, np.random.default_rng(0)), None),
    ],
)
def test_batches_and_blocks_agree(lattice: FrequencyLattice, block: Block | None) -> None:
    mesh = icosphere(3)
    found, expected = (
        transform_block(mesh, lattice, block or lattice.half, DOUBLE, Execution(backend, batch=20_000))
        for backend in (Device().backend(), CPU)
    )
    assert_agree(found, expected, mesh)


def test_a_small_device_computes_in_parts_and_never_runs_out(caplog: pytest.LogCaptureFixture) -> None:
    mesh, device = icosphere(3), Device(capacity=6e7)
    found = on(device.backend(), mesh, ROUGH)
    assert device.options[0]["n_modes"] != LATTICE.shape
    assert not caplog.records
    assert_agree(found, on(CPU, mesh, ROUGH), mesh, 5e-9)
    assert device.used == 0


@pytest.mark.slow
def test_what_is_foreseen_of_a_device_is_what_it_takes() -> None:
    mesh, device = icosphere(5), Device()
    on(device.backend(), mesh, ROUGH, batch=100_000)
    allowed = device.most_used / 0.9
    assert on(Device(capacity=allowed + 1e8).backend(), mesh, ROUGH, batch=100_000).backend == "cufinufft"
    # Points: what a batch holds at most, over the points of a batch.
    assert device.most_used < 100_000 * GPU_COSTS.point_bytes + 60 * len(mesh.triangles) + 20e6


@pytest.mark.parametrize("where", ["plan", "setpts", "execute"])
@pytest.mark.parametrize("times", [1, 2])
def test_out_of_memory_is_tried_again_in_smaller_parts(
    where: str, times: int, caplog: pytest.LogCaptureFixture
) -> None:
    mesh, lattice, device = icosphere(3), Lattice(5.0, 64), Device(failures=[(where, "memory")] * times)
    found, expected = (
        transform_block(mesh, lattice, lattice.half, ROUGH, Execution(backend)) for backend in (device.backend(), CPU)
    )
    assert_agree(found, expected, mesh, 5e-9)
    assert [record.levelname for record in caplog.records] == ["WARNING"] * times
    assert "cufinufft: out of memory; trying again with" in caplog.text
    assert device.used == 0


@pytest.mark.parametrize(
    ("device", "reason", "warnings"),
    [
        (Device(failures=[("execute", "memory")] * 20), "out of memory", 3),
        # Too small for anything, and not tried.
        (Device(capacity=1e6), "out of memory", 1),
        *((Device(failures=[(where, "error")] * 2), "Error ", 1) for where in ("plan", "setpts", "execute")),
    ],
)
def test_the_processor_steps_in(device: Device, reason: str, warnings: int, caplog: pytest.LogCaptureFixture) -> None:
    mesh = icosphere(2)
    found = on(device.backend(), mesh)
    assert found.backend.startswith(f"finufft after cufinufft: {reason}")
    assert np.array_equal(found.values, on(CPU, mesh).values)
    assert len(caplog.records) == warnings
    assert "the processor computes it instead" in caplog.records[-1].message
    assert device.used == 0
    assert bool(device.options) == (device.capacity > 1e6)


def test_arrays_that_run_out_of_memory_count_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Gpu, "free_bytes", 1e9)  # as with a limit on CuPy's pool, which CUDA does not know
    found = on(Device(capacity=3e5).backend(), icosphere(3))
    assert found.backend == "finufft after cufinufft: out of memory"


def test_a_failure_that_is_not_explained_counts_as_memory_where_little_is_left() -> None:
    mesh, lattice = icosphere(2), Lattice(5.0, 64)
    device = Device(capacity=2e8, failures=[("plan", "error")] * 2)
    found = transform_block(mesh, lattice, lattice.half, ROUGH, Execution(device.backend()))
    assert found.backend == "cufinufft"
    assert [options["gpu_method"] for options in device.options] == [3, 0, 3]


def test_a_device_without_the_shared_memory_for_the_fastest_method_uses_another() -> None:
    mesh, device = icosphere(2), Device(failures=[("plan", "error")])
    assert_agree(on(device.backend(), mesh), on(CPU, mesh), mesh)
    assert [options["gpu_method"] for options in device.options] == [3, 0]


def test_a_plan_serves_the_meshes_that_follow_until_memory_is_short() -> None:
    device = Device()
    backend = device.backend()
    for level in (1, 2, 3):
        mesh = icosphere(level)
        assert_agree(on(backend, mesh), on(CPU, mesh), mesh)
    assert len(device.options) == 1
    # Other accuracies need other plans, of which the last ones are kept.
    one = device.used
    for eps in np.geomspace(1e-9, 1e-12, 9):
        on(backend, mesh, TransformSettings(eps))
    assert one < device.used < 5 * one
    made = len(device.options)
    on(backend, mesh, TransformSettings(eps))
    assert len(device.options) == made
    # What is kept counts as free, and is given up for what needs the memory.
    assert backend.free_bytes > device.capacity - device.used
    backend.release_memory(device.capacity)
    assert device.used == 0


# Close to the lattice's highest frequency, and where triangles span many waves.
@pytest.mark.parametrize("device", ["fake", "gpu"])
@pytest.mark.parametrize("highest", [0.05, 5.0, 80.0])
def test_exact_transforms_agree(
    device: str, highest: float, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    backend = device_of(device)
    monkeypatch.setattr(exact, "_FEWEST_FOR_GPU", 1)
    mesh = MESHES["uneven"]
    frequencies = np.random.default_rng(0).uniform(-highest, highest, (32, 3))
    found, expected = (exact_transform(mesh, frequencies, each, threads=2) for each in (backend, CPU))
    assert np.abs(found - expected).max() < 1e-13 * mesh.area
    # Else the processor may have been compared with itself.
    assert not caplog.records


@pytest.mark.parametrize("device", ["fake", "gpu"])
@pytest.mark.parametrize("name", ["uneven", "icosphere 5", "far"])
def test_rules_are_chosen_alike(
    device: str, name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # The last one is large beside the wavelength.
    mesh = {"icosphere 5": icosphere(5), "far": icosphere(5).moved(40.0, (0, 0, 0))}.get(name) or uneven()
    lattice, backend = OctaveLattice.random(3.0, 6.0, 16, np.random.default_rng(0)), device_of(device)
    monkeypatch.setattr(kinds, "_MANY_TRIANGLES", 1)
    chosen = []
    for each in (backend, CPU):
        plan: Any = ROUGH.kind_for(mesh, lattice)
        plan.choose_points(each)
        chosen.append([(use.rule, use.splits, use.members.tolist()) for use in plan.uses])
    assert chosen[0] == chosen[1]
    assert not caplog.records


@pytest.mark.parametrize("vertex_count", [41, 1 << 40])
def test_edges_are_merged_alike(vertex_count: int) -> None:
    rng = np.random.default_rng(5)
    # Edges of one, two and many triangles, of some that repeat a vertex, and of a vertex with very many.
    corners, areas = rng.integers(0, 40, size=(3, 2000)), rng.uniform(size=2000)
    corners[0, 1000:] = 7
    ends, sums = merged_edges(corners, areas, 41)
    device = Device()
    others, other_sums = merged_edges(device.upload(corners), device.upload(areas), vertex_count)
    assert np.array_equal(ends, others.host)
    assert other_sums.host == pytest.approx(sums, rel=1e-14)


def test_the_processor_computes_exact_transforms_where_a_gpu_fails(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(exact, "_FEWEST_FOR_GPU", 1)
    mesh, frequencies = icosphere(3), np.full((32, 3), 1.5)
    found = exact_transform(mesh, frequencies, Device(capacity=1e4).backend())
    # Whether this takes compiled loops, depends on what the process computed before.
    assert np.abs(found - exact_transform(mesh, frequencies)).max() < 1e-13 * mesh.area
    assert "the GPU fails: Out of memory" in caplog.text


def test_memory_bounds_the_processor_that_steps_in() -> None:
    mesh, device = icosphere(3), Device(failures=[("execute", "error")])
    found = on(device.backend(), mesh, ROUGH, allowed_bytes=1.2e7)
    assert found.backend.startswith("finufft after")
    assert np.array_equal(found.values, on(CPU, mesh, ROUGH, allowed_bytes=1.2e7).values)
    with pytest.raises(InputError, match="give at least"):
        on(Device().backend(), mesh, allowed_bytes=1e6)


def test_two_threads_take_turns() -> None:
    mesh, backend = icosphere(1), Device().backend()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: on(backend, mesh), range(8)))
    assert {each.backend for each in found} == {"cufinufft"}
    assert all(np.array_equal(each.values, found[0].values) for each in found)


def test_fields_carry_their_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = Device().backend()
    mesh = icosphere(2)
    assert compute_field(mesh, LATTICE, TransformSettings(), [-2.0], Execution(backend)).backend == "cufinufft"
    target = ErrorTarget((-2.0,), (1e-3,))
    assert field_for(mesh, LATTICE, target, TransformSettings(), Execution(backend)).backend == "cufinufft"
    assert field_for(Sphere(), LATTICE, target, TransformSettings(), Execution(backend)).backend == "closed form"
    monkeypatch.setattr(backends, "gpu_backend", lambda: backend)
    attributes = {name: fourier_transform(mesh, LATTICE, backend=name).attrs["backend"] for name in ("gpu", "auto")}
    assert attributes == {"gpu": "cufinufft", "auto": "cufinufft"}
    assert fourier_transform(mesh, LATTICE).attrs["backend"] == "finufft"


def test_auto_means_the_processor_where_there_is_no_gpu(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def missing() -> Gpu:
        raise BackendError("no GPU: none")

    caplog.set_level(logging.INFO)
    monkeypatch.setattr(backends, "gpu_backend", missing)
    assert backend_named("auto") is CPU
    assert "computing on the processor: no GPU: none" in caplog.text
    with pytest.raises(BackendError, match="no GPU: none"):
        fourier_transform(icosphere(0), LATTICE, backend="gpu")
    with pytest.raises(InputError, match="backend must be one of cpu, gpu, auto, found 'tpu'"):
        backend_named("tpu")


def test_the_trial_compares_values() -> None:
    try_out(Device().backend())
    with pytest.raises(BackendError, match="fails a trial transform: Error executing plan"):
        try_out(Device(failures=[("execute", "error")]).backend())


def test_backends_survive_pickling() -> None:
    assert pickle.loads(pickle.dumps(CPU)) is CPU
    assert Device().backend().__reduce__() == (gpu_backend, ())


def pathfinder(missing: str = "") -> Any:
    """A pathfinder that does not find one of the libraries."""

    def load(name: str) -> Any:
        if name == missing:
            raise RuntimeError("not found")
        return SimpleNamespace(abs_path=None)  # the process itself

    return SimpleNamespace(load_nvidia_dynamic_lib=load)


def no_device(status: int, driver: int = 0) -> Any:
    count = Mock(return_value=0, side_effect=CUDARuntimeError(status) if status else None)
    runtime = SimpleNamespace(CUDARuntimeError=CUDARuntimeError, getDeviceCount=count, driverGetVersion=lambda: driver)
    return SimpleNamespace(cuda=SimpleNamespace(runtime=runtime))


@pytest.mark.parametrize(
    ("modules", "message"),
    [
        ({}, r"^no GPU: cuda-pathfinder is not installed: pip install 'sobolev-batch\[gpu\]'$"),
        (
            {"cuda.pathfinder": pathfinder("cudart")},
            r"^no GPU: the CUDA runtime \(cudart\) is not installed or cannot .*gpu",
        ),
        ({"cuda.pathfinder": pathfinder("cufft")}, r"^no GPU: cuFFT \(cufft\) is not installed .*pip install"),
        ({"cuda.pathfinder": pathfinder()}, r"^no GPU: CuPy is not installed: pip install"),
        ({"cuda.pathfinder": pathfinder(), "cupy": no_device(0)}, r"^no GPU: cuFINUFFT is not installed: pip install"),
        (
            {"cuda.pathfinder": pathfinder(), "cupy": no_device(0), "cufinufft": ImportError("bad\nlibrary")},
            r"^no GPU: cuFINUFFT is installed but cannot be imported \(bad library\): pip install",
        ),
        ({"cupy": no_device(35)}, "^no GPU: the NVIDIA driver is not installed on this machine$"),
        ({"cupy": no_device(35, 11000)}, "^no GPU: the NVIDIA driver is too old for CUDA 12: update it"),
        *(({"cupy": no_device(n)}, "^no GPU: the NVIDIA driver sees no device; is CUDA_VIS") for n in (0, 100)),
        ({"cupy": no_device(999)}, "^no GPU: CUDA says cudaError 999$"),
    ],
)
def test_says_in_one_line_what_is_missing(
    modules: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "cuda.pathfinder" not in modules and modules:
        modules = {"cuda.pathfinder": pathfinder(), "cufinufft": SimpleNamespace(), **modules}

    def import_module(name: str) -> Any:
        found = modules.get(name, ModuleNotFoundError(name))
        if isinstance(found, ImportError):
            raise found
        return found

    monkeypatch.setattr(backends, "importlib", SimpleNamespace(import_module=import_module))
    with pytest.raises(BackendError, match=message):
        Gpu.load()


# The real libraries, with or without a device.


@pytest.fixture(scope="module")
def real_cupy() -> Any:
    pytest.importorskip("cuda.pathfinder", reason="cuda-pathfinder comes with the extra 'gpu'")
    return pytest.importorskip("cupy", reason="CuPy comes with the extra 'gpu'")


def run_program(code: str, *options: str) -> subprocess.CompletedProcess[str]:
    program = f"from sobolev_batch.transform import backends\n{textwrap.dedent(code)}"
    return subprocess.run([sys.executable, *options, "-c", program], capture_output=True, text=True, check=True)


def test_cupy_answers_what_the_fake_answers(real_cupy: Any) -> None:
    for name in FUNCTIONS:
        assert getattr(real_cupy, name) is not getattr(np, name), name
    for name in UFUNCS:
        assert isinstance(getattr(real_cupy, name), real_cupy.ufunc), name
    assert {name for name in vars(Array) if not name.startswith("_")} <= set(dir(real_cupy.ndarray))


@pytest.mark.process
def test_cufinufft_is_loaded_with_what_it_needs_and_says_what_is_missing(real_cupy: Any) -> None:
    done = run_program(
        """
        import sys
        try:
            print("found", backends.gpu_backend().description)
        except backends.BackendError as error:
            print("cufinufft" in sys.modules, error)
        """,
        "-W",
        "error",
    )
    assert done.stdout.startswith(("found", "True no GPU: the NVIDIA driver")), done.stdout
    assert not done.stderr


@pytest.mark.process
def test_a_plan_that_cannot_be_made_leaves_nothing_behind_and_options_are_those_of_the_fake(real_cupy: Any) -> None:
    # cuFINUFFT knows no oversampling of 1.5, whether or not there is a device.
    done = run_program("""
        backends._require_device = lambda cupy: None
        backend = backends.Gpu.load()
        try:
            backend._new_plan(backends.NufftSpec((8, 8, 8), 1e-9, oversampling=1.5), adjoint=False, method=0)
        except RuntimeError as error:
            print(error, backend.is_out_of_memory(error))
        from cufinufft._cufinufft import NufftOpts
        print(*(name for name, _ in NufftOpts._fields_))
    """)
    failure, options = done.stdout.splitlines()
    assert failure == "Error creating plan. False"
    assert set(options.split()) == OPTIONS
    assert "Exception ignored" not in done.stderr
    assert "upsampfac=1.5 cannot be handled" in done.stderr


def test_a_gpu_agrees_in_parts_and_falls_back_without_memory(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, pool = icosphere(4), gpu.cupy.get_default_memory_pool()
    pool.free_all_blocks()
    pool.set_limit(size=1 << 16)
    try:
        found = on(gpu, mesh)
    finally:
        pool.set_limit(size=0)
    assert found.backend == "finufft after cufinufft: out of memory"
    monkeypatch.setattr(Gpu, "free_bytes", 7e7)
    assert_agree(on(gpu, icosphere(5)), on(CPU, icosphere(5)), icosphere(5))
