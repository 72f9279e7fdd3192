"""What results share: plain numbers, items of a batch, and items put back into their places."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from gyrofuse._base.results import ConfidenceInterval, Result, plain, scattered


@dataclass(frozen=True, eq=False)
class Inner(Result):
    value: Tensor

    _batched = ("value",)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return tuple(self.value.shape)


@dataclass(frozen=True, eq=False)
class Outer(Result):
    estimate: Tensor
    interval: ConfidenceInterval
    inner: Inner | None
    names: tuple[str, ...] = ()

    _batched = ("estimate", "interval", "inner")
    _contents = ("estimate", "interval", "names", "size")

    def summary(self) -> str:
        return f"{self.size} numbers"

    @property
    def size(self) -> int:
        return self.estimate.shape[-1]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return tuple(self.estimate.shape[:-1])


def result() -> Outer:
    x = torch.arange(6.0).view(3, 2)
    return Outer(x, ConfidenceInterval(x - 1, x + 1), Inner(x[:, 0]), ("a", "b"))


def test_items_of_a_batch_with_all_that_belongs_to_them():
    item = result()[1]
    assert item.estimate.tolist() == [2, 3]
    assert item.interval.low.tolist() == [1, 2]
    assert item.inner is not None
    assert item.inner.value.item() == 2
    assert item.names == ("a", "b")
    assert result()[1:].batch_shape == (2,)


def test_more_indices_than_dimensions_are_refused():
    with pytest.raises(IndexError, match=r"at most 1 indices for batch shape \(3,\)"):
        result()[0, 0]
    item = result()[0]
    with pytest.raises(IndexError, match=r"at most 0 indices for batch shape \(\)"):
        item[0]


def test_text_is_the_summary_and_numbers_are_plain():
    assert str(result()) == "2 numbers"
    content = result()[0].to_dict()
    assert list(content) == ["estimate", "interval", "names", "size"]
    assert json.loads(json.dumps(content))["interval"] == {"low": [-1, 0], "high": [1, 2]}


def test_what_is_not_finite_is_none():
    assert plain(torch.tensor([1.0, torch.nan, torch.inf])) == [1.0, None, None]
    assert plain({"x": float("nan"), "y": [float("inf"), "text"]}) == {"x": None, "y": [None, "text"]}


def test_items_go_back_into_their_places():
    usable = torch.tensor([True, False, True, False])
    whole = scattered(torch.tensor([[1.0], [2.0]]), usable, (2, 2))
    assert whole.shape == (2, 2, 1)
    assert whole[:, 0, 0].tolist() == [1, 2]
    assert bool(whole[:, 1].isnan().all())
    assert scattered(torch.tensor([7, 8]), usable, (4,), -1).tolist() == [7, -1, 8, -1]
