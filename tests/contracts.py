"""What every operation of the library keeps, written once.

A member is an operation seen as a function of a signal `(..., sensor, time)`, that gives a tensor or several. Each
`check_...` tests one promise of a member; `test_contracts.py` applies them all.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

Output = Tensor | list[Tensor]


@dataclass(frozen=True)
class Member:
    """One operation of the library and which of the promises apply to it.

    Attributes:
        name: For the test's name.
        make: Makes the operation, a function or a module, always the same one.
        differentiable: Whether gradients reach the signal.
        module: Whether it is an `nn.Module`, which compiles and exports whole, and has a state.
        onnx: Whether every operator in it exists in ONNX.
        tolerance: Relative, for the same computation in another order.
    """

    name: str
    make: Callable[[], Any]
    differentiable: bool = False
    module: bool = False
    onnx: bool = False
    tolerance: float = 1e-10

    def __call__(self, signal: Tensor) -> list[Tensor]:
        return listed(self.make()(signal))


def listed(output: Output) -> list[Tensor]:
    return [output] if isinstance(output, Tensor) else list(output)


def assert_same(got: Output, expected: Output, rtol: float) -> None:
    """Equal up to `rtol` of the largest element of each tensor, in shape and dtype too."""
    got, expected = listed(got), listed(expected)
    assert len(got) == len(expected)
    for g, e in zip(got, expected, strict=True):
        finite = e[e.isfinite()].abs()
        size = finite.max().item() if finite.numel() else 0.0
        torch.testing.assert_close(g, e, rtol=rtol, atol=rtol * size, equal_nan=True)


def check_a_batch_is_its_items(member: Member, signal: Tensor) -> None:
    """Leading dimensions are independent items: `signal` is `(a, b, sensor, time)`."""
    whole = member(signal)
    items = [member(item) for item in signal.flatten(0, 1)]
    for k, got in enumerate(whole):
        stacked = torch.stack([item[k] for item in items])
        assert_same(got, stacked.unflatten(0, signal.shape[:2]), member.tolerance)


def check_dtype_and_device_are_kept(member: Member, signal: Tensor) -> None:
    """Results have the dtype and device of the signal, and float32 gives what float64 gives but for its digits."""
    exact = member(signal.double())
    single = member(signal.float())
    for double, got in zip(exact, single, strict=True):
        assert double.dtype == torch.float64
        assert got.dtype == torch.float32
        assert got.device == double.device == signal.device
    assert_same([got.double() for got in single], exact, 1e-3)


def check_memory_layout_does_not_matter(member: Member, signal: Tensor) -> None:
    """Transposed, strided, shifted and expanded signals give the same as fresh ones; `signal` is `(sensor, time)`."""
    expected = member(signal)
    twice = signal.repeat_interleave(2, dim=-1)
    padded = nn.functional.pad(signal, (3, 2, 1, 1))
    for view in (signal.mT.contiguous().mT, twice[:, ::2], padded[1:-1, 3:-2]):
        assert not view.is_contiguous()
        assert torch.equal(view, signal)
        assert_same(member(view), expected, member.tolerance)
    expanded = signal.expand(2, 3, *signal.shape)
    assert expanded.stride()[:2] == (0, 0)
    for got, one in zip(member(expanded), expected, strict=True):
        assert_same(got, one.expand(2, 3, *one.shape), member.tolerance)


def check_the_signal_is_left_alone(member: Member, signal: Tensor) -> None:
    before = signal.clone()
    member(signal)
    assert torch.equal(signal, before)


def check_global_state_is_left_alone(member: Member, signal: Tensor) -> None:
    """Random generators, threads, default dtype, gradient mode and determinism stay as they are."""

    def state() -> tuple[object, ...]:
        return (
            torch.get_rng_state().tolist(),
            random.getstate(),
            str(np.random.get_state()),  # noqa: NPY002
            torch.get_num_threads(),
            torch.get_default_dtype(),
            torch.is_grad_enabled(),
            torch.are_deterministic_algorithms_enabled(),
        )

    before = state()
    member(signal)
    assert state() == before


def check_gradients(member: Member, signal: Tensor) -> None:
    """Analytic gradients equal numerical ones; no gradient is recorded where none is asked for."""
    assert not any(output.requires_grad for output in member(signal))
    leaf = signal.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: tuple(member(x)), leaf, fast_mode=True)


def check_compiles(member: Member, signal: Tensor, longer: Tensor) -> None:
    """`torch.compile` takes a module in one graph, whatever the length of the signal."""
    torch._dynamo.reset()
    module = member.make()
    compiled = torch.compile(module, backend="aot_eager", fullgraph=True)
    for x in (signal, longer):
        assert_same(compiled(x), module(x), member.tolerance)


def check_exports(member: Member, signal: Tensor, longer: Tensor) -> None:
    """`torch.export` gives a program for signals of any length."""
    module = member.make()
    time = torch.export.Dim("time", min=64, max=2**24)
    program = torch.export.export(module, (signal,), dynamic_shapes=({1: time},))
    assert_same(program.module()(longer), module(longer), member.tolerance)


def check_runs_in_onnxruntime(member: Member, signal: Tensor, longer: Tensor, folder: Path) -> None:
    """An ONNX file gives the same in onnxruntime, for signals of any length."""
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    module = member.make().eval()
    time = torch.export.Dim("time", min=64, max=2**24)
    program = torch.onnx.export(module, (signal,), dynamo=True, dynamic_shapes=({1: time},), verbose=False)
    assert program is not None
    program.save(folder / "module.onnx")
    session = onnxruntime.InferenceSession(folder / "module.onnx")
    for x in (signal, longer):
        outputs = session.run(None, {session.get_inputs()[0].name: x.numpy()})
        assert_same([torch.from_numpy(output) for output in outputs], module(x), 1e-4)


def check_state_goes_round(member: Member, signal: Tensor) -> None:
    """`state_dict` is all there is to know about a module, and a copy gives the same."""
    module = member.make()
    blank = copy.deepcopy(module)
    for name in module.state_dict():
        blank.get_buffer(name).zero_()
    blank.load_state_dict(module.state_dict())
    assert_same(blank(signal), module(signal), 0.0)
    assert list(module.parameters()) == []


def check_cuda_equals_cpu(member: Member, signal: Tensor) -> None:
    operation = member.make()
    expected = operation(signal)
    on_device = operation.cuda() if isinstance(operation, nn.Module) else operation
    got = listed(on_device(signal.cuda()))
    assert all(output.is_cuda for output in got)
    assert_same([output.cpu() for output in got], expected, member.tolerance)
