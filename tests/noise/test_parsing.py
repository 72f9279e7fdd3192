"""Models read from formulas and dictionaries."""

from __future__ import annotations

import pytest
import torch

from gyrofuse.noise.parsing import model_from_dict, parse_model
from gyrofuse.noise.processes import AR1, WhiteNoise


@pytest.mark.parametrize(
    ("formula", "meaning"),
    [
        ("WN", "WhiteNoise()"),
        ("WN + 2*AR1 + RW + SIN", "WhiteNoise() + AR1() + AR1() + RandomWalk() + Sinusoid()"),
        ("qn+dr", "QuantizationNoise() + Drift()"),
        ("WhiteNoise + random_walk + GM", "WhiteNoise() + RandomWalk() + AR1()"),
        (" 2 * (AR1 + Sin)\n + wn ", "AR1() + Sinusoid() + AR1() + Sinusoid() + WhiteNoise()"),
        (
            "WN(variance=1e-4) + AR1(phi=-0.99, variance=1e-6)",
            "WhiteNoise(variance=0.0001) + AR1(phi=-0.99, variance=1e-06)",
        ),
        ("AR1(phi=0.5)", "AR1(phi=0.5)"),
        ("DR(slope=-2)", "Drift(slope=-2.0)"),
    ],
)
def test_formulas(formula, meaning):
    assert str(parse_model(formula)) == meaning


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("", "cannot read '' near character"),
        ("WN +", r"cannot read 'WN \+' near character 4"),
        ("WN RW", "near character"),
        ("WN + XY", r"at character 6 of 'WN \+ XY': unknown process 'XY'; known: WN \(WhiteNoise\)"),
        ("WN + AR", "unknown process 'AR'; did you mean AR1\\? known: WN"),
        ("WM", "unknown process 'WM'; did you mean WN\\? known: WN"),
        ("WhiteNose", "unknown process 'WhiteNose'; did you mean WN\\?"),
        ("WN - RW", "expected processes joined by"),
        ("-AR1", "expected processes joined by"),
        ("2*3", "expected processes joined by"),
        ("1.5*AR1", "at character 1.*expected a whole number >= 1, got 1.5"),
        ("0*AR1", "expected a whole number >= 1, got 0"),
        ("AR1*2", "at character 1.*expected a number, got 'AR1'"),
        ("AR1(tau=1)", "AR1 has no parameter `tau`; known: phi, variance"),
        ("AR1(0.9, 1)", "at character 5.*expected `name=number` in AR1"),
        ("WN(variance='a')", "expected a number, got \"'a'\""),
        ("WN(variance=x)", "expected a number, got 'x'"),
        ("AR1(phi=2)", "`phi` of AR1: expected a number strictly between -1 and 1, got 2"),
        ("2*WN", "WhiteNoise appears more than once"),
    ],
)
def test_formulas_that_cannot_be_read(formula, message):
    with pytest.raises(ValueError, match=message):
        parse_model(formula)


def test_dictionary_keeps_batches_and_unknowns():
    model = AR1(torch.tensor([[0.5, 0.6]], dtype=torch.float64), 1.0) + WhiteNoise()
    again = model_from_dict(model.to_dict())
    assert again.to_dict() == model.to_dict()
    assert again.processes[0].phi.shape == (1, 2)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({}, "expected the entry 'processes' of a model or 'components' of an array"),
        ({"processes": []}, "at least one process"),
        ({"processes": [{"process": "Pink"}]}, "unknown process 'Pink'.*known: WN"),
        ({"processes": [{"process": "AR"}]}, "unknown process 'AR'; did you mean AR1"),
        ({"processes": [{"variance": 1.0}]}, "unknown process None"),
        (
            {"processes": [{"process": "AR1", "theta": 1.0}]},
            "AR1 has no parameter theta; known: phi, variance",
        ),
        ({"components": [{"processes": [{"process": "AR1"}]}]}, "with a 'covariance' or 'gains'"),
        ({"components": [{"covariance": [[1.0]]}]}, "expected one process"),
    ],
)
def test_dictionaries_that_cannot_be_read(description, message):
    with pytest.raises(ValueError, match=message):
        model_from_dict(description)


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("WN + 999999*AR1", "at most 50 processes, got 999999"),
        ("9*(9*(9*(9*(9*(9*(9*(9*(AR1))))))))", "at most 50 processes, got 81"),
        ("+".join(["AR1"] * 51), "at most 50 processes, got 51"),
        ("+".join(["WN"] * 20_000), "at most 1000 characters, got 59999"),
        ("-" * 999 + "1", "nested too deeply|expected processes"),
        ("WN(variance=1" + "0" * 400 + ")", "expected a number"),
        ("WN(variance={[]: 1})", "expected a number"),
    ],
)
def test_formulas_that_would_never_end_are_refused(formula, message):
    with pytest.raises(ValueError, match=message):
        parse_model(formula)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"processes": "WN"}, "expected 'processes' to be a list of dictionaries, got 'WN'"),
        ({"components": [1]}, "expected 'components' to be a list of dictionaries"),
        ({"processes": [{"process": "WN", "variance": 10**400}]}, "expected a number for variance"),
        ({"processes": [{"process": "WN", "variance": [1, [2]]}]}, "expected a number for variance"),
        ({"processes": [{"process": "WN", "variance": "1"}]}, "expected a number for variance"),
    ],
)
def test_descriptions_that_are_none_are_refused(description, message):
    with pytest.raises(ValueError, match=message):
        model_from_dict(description)
