"""The third wall: what the library says of a recording, given what a user would have."""

from __future__ import annotations

from typing import Any

import torch

import gyrofuse as gf
from gyrofuse.fitting import RankResult

_PROCESSES = {
    "white_noise": gf.WhiteNoise,
    "quantization_noise": gf.QuantizationNoise,
    "ar1": gf.AR1,
    "random_walk": gf.RandomWalk,
    "drift": gf.Drift,
    "sinusoid": gf.Sinusoid,
}


def analyse(recording: dict[str, Any], simulation: dict[str, Any], *, false_alarm: float = 0.01) -> dict[str, Any]:
    """Diagnose arrays as they lie in a log, and give the report's dictionary."""
    return gf.diagnose(recording_of(recording), simulation_of(simulation), false_alarm=false_alarm).to_dict()


def recording_of(arrays: dict[str, Any]) -> gf.Recording:
    """Gyroscopes and auxiliary channels."""
    channels = {
        name: torch.as_tensor(values, dtype=torch.float64)
        for name, values in arrays.items()
        if name not in ("gyro", "fs", "unit", "sensors", "time")
    }
    signal = torch.as_tensor(arrays["gyro"], dtype=torch.float64)
    return gf.Recording(signal, rate=float(arrays["fs"]), unit=str(arrays["unit"]), channels=channels)


def simulation_of(given: dict[str, Any]) -> gf.Recording | gf.Model | gf.ArrayModel | RankResult:
    """Samples, a noise model, or one that is fitted to earlier records here."""
    if "fit" in given:
        return fitted(given)
    if "terms" not in given:
        return recording_of(given)
    return gf.ArrayModel.from_sensors(noise_models(given["terms"]))


def fitted(given: dict[str, Any]) -> gf.Model | gf.ArrayModel | RankResult:
    """The noise model that a user would fit to what was recorded earlier."""
    earlier = [gf.Recording(torch.as_tensor(x), rate=given["fs"]) for x in (given["gyro"], *given["more"])]
    by, model = given["fit"]["by"], given["fit"]["model"]
    if by == "array":
        return gf.fit_array_gmwm(earlier[0], model).model
    if by == "jointly":
        return gf.fit_gmwm_joint(earlier, model).model
    if by == "ranked":
        return gf.rank_models(earlier[0])
    return gf.fit_gmwm(earlier[0], model, refine=by == "refined").model


def noise_models(terms: list[list[list[Any]]]) -> list[gf.Model]:
    """One for each sensor."""
    return [gf.Model([_PROCESSES[name](**numbers) for name, numbers in sensor]) for sensor in terms]
