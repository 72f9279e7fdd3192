"""Whether two installs of gyrofuse compute the same.

    python tests/benchmarks/same_results.py write NEW.json [--data FOLDER]
    python tests/benchmarks/same_results.py compare OLD.json NEW.json [--tolerance 1e-12]

The first form computes WCCV, weights, intervals, fits, rankings and diagnoses of simulated arrays, and of the
recordings of a folder where one is given, with the install that Python finds. The second lists what differs by more
than the tolerance, relative to the largest number of its list, and ends with status 1 where something does.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gyrofuse as gf

METHODS = ("svo", "auto", "nonnegative", "inverse_variance", "equal", "shrinkage", "rdvg", "assisted", "model_assisted")
COVARIANCES = ("model", "block_bootstrap", "none")
MODELS = ("WN + RW", "WN + AR1", "QN + WN + RW", "WN + AR1 + RW + DR", "2*AR1 + WN", "WN + SIN")


def simulated(n_sensors: int, n_samples: int, seed: int) -> torch.Tensor:
    """White noise and random walks of unequal sizes with a part that the sensors share, `(sensor, time)`."""
    rng = np.random.default_rng(seed)
    size = np.linspace(0.7, 1.8, n_sensors)[:, None]
    white = size * rng.normal(size=(n_sensors, n_samples)) + 0.3 * rng.normal(size=n_samples)
    walk = 3e-3 * size[::-1] * rng.normal(size=(n_sensors, n_samples)).cumsum(1)
    pole = np.zeros((n_sensors, n_samples))
    steps = 0.1 * rng.normal(size=(n_sensors, n_samples))
    for t in range(1, n_samples):
        pole[:, t] = 0.97 * pole[:, t - 1] + steps[:, t]
    return torch.from_numpy(white + walk + pole)


def recordings(folder: Path) -> Iterator[tuple[str, torch.Tensor]]:
    """Arrays at rest of a folder of recordings, `(sensor, time)`, at most 2**16 samples of each."""
    n = 2**16
    for i in (1, 2):
        path = folder / f"adis16405_rec{i}.npz"
        if path.is_file():
            yield path.stem, torch.from_numpy(np.load(path)["counts"][:3, :n].astype(float))
    path = folder / "xsensdot10_static.npz"
    if path.is_file():
        signal = np.load(path)["data"][1:, 3, :14000].astype(float)  # the first sensor has gaps
        yield path.stem, torch.from_numpy(signal)
    path = folder / "mimu4444_8imu.npz"
    if path.is_file():
        yield path.stem, torch.from_numpy(np.load(path)["exp1"][:1400, :, 3].T.astype(float))


def plain(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.tolist()
    return value.to_dict() if hasattr(value, "to_dict") else value


def of_array(signal: torch.Tensor) -> Iterator[tuple[str, Callable[[], Any]]]:
    """What is computed of an array, by name."""
    yield "wccv", lambda: gf.wavelet_cross_covariance(signal)
    yield "wv", lambda: gf.wavelet_variance(signal)
    yield "robust wv", lambda: gf.robust_wavelet_variance(signal)
    yield "wv interval", lambda: list(map(plain, gf.wavelet_variance_interval(signal)))
    yield "wccv interval", lambda: list(map(plain, gf.wavelet_cross_covariance_interval(signal)))
    yield "equal", lambda: gf.fit_svo(signal, method="equal")
    for scales in ("flat", "short", "long"):
        yield f"svo {scales}", lambda scales=scales: gf.fit_svo(signal, scales)
    for method in METHODS:
        yield f"svo {method}", lambda method=method: gf.fit_svo(signal, method=method, covariance="none")
    for covariance in COVARIANCES:
        yield f"svo covariance {covariance}", lambda c=covariance: gf.fit_svo(signal, covariance=c)
    yield "gain", lambda: gf.fit_svo(signal).gain_over_equal()
    yield "summary", lambda: str(gf.fit_svo(signal))
    yield "multiscale", lambda: gf.fit_multiscale(signal, 6)
    yield "virtual", lambda: gf.fit_multiscale(signal, 6).virtual(signal)[..., ::97]
    yield "array gmwm", lambda: gf.fit_array_gmwm(signal, "WN + RW")
    yield "parity", lambda: gf.parity_test(signal[:, -2048:], gf.fit_svo(signal[:, :-2048]), window=256)


def of_sensors(signal: torch.Tensor) -> Iterator[tuple[str, Callable[[], Any]]]:
    """What is computed of each sensor by itself, by name."""
    for model in MODELS:
        yield f"gmwm {model}", lambda model=model: gf.fit_gmwm(signal, gf.parse_model(model))
    yield "gmwm refined", lambda: gf.fit_gmwm(signal, gf.parse_model("WN + AR1 + RW"), refine=True)
    yield "gmwm robust", lambda: gf.fit_gmwm(signal, gf.parse_model("WN + RW"), efficiency=0.6)
    yield "ranking", lambda: gf.rank_models(signal)
    yield "ranking text", lambda: str(gf.rank_models(signal))


def of_models() -> Iterator[tuple[str, Callable[[], Any]]]:
    """What is computed of models, by name."""
    model = gf.WhiteNoise(1.0) + gf.AR1(0.95, 0.01) + gf.RandomWalk(1e-6) + gf.QuantizationNoise(0.2)
    yield "model wv", lambda: model.wavelet_variance(16)
    yield "model spectrum", lambda: model.spectrum(torch.linspace(0.001, 0.5, 200, dtype=torch.float64))
    yield "model path", lambda: model.simulate(1000, generator=torch.Generator().manual_seed(1))
    yield "model datasheet", lambda: gf.datasheet(model, 100.0, "rad/s")
    yield "model kalibr", lambda: gf.to_kalibr(model, 100.0, "rad/s")
    yield "model c header", lambda: gf.to_c_header(model, 100.0, "rad/s")


def of_diagnosis() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Diagnoses of a simulated array with and without a tone, by name."""
    signal, simulation = simulated(3, 2**14, 5), simulated(3, 2**14, 6)
    tone = 0.06 * torch.sin(2 * math.pi * 0.083 * torch.arange(signal.shape[-1], dtype=torch.float64))
    for name, observed in (("without", signal), ("with a tone", signal + tone)):
        yield (
            name,
            lambda observed=observed: gf.diagnose(
                gf.Recording(observed, 100.0, "rad/s"), gf.Recording(simulation, 100.0, "rad/s")
            ),
        )


def outcome(call: Callable[[], Any]) -> Any:
    """What a call gives; an error as its text, for an install may lack an option."""
    try:
        return call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def computed(folder: Path | None) -> dict[str, Any]:
    """Everything, by name; an error as its text."""
    parts: dict[str, Iterator[tuple[str, Callable[[], Any]]]] = {"models": of_models(), "diagnosis": of_diagnosis()}
    signals = [("array", simulated(5, 2**14, 1)), ("long array", simulated(3, 2**16, 2))]
    for name, signal in [*signals, *(recordings(folder) if folder else ())]:
        parts[name] = of_array(signal)
        parts[f"{name}, each sensor"] = of_sensors(signal[:3])
    found = {}
    for part, entries in parts.items():
        for name, call in entries:
            found[f"{part}: {name}"] = plain(outcome(call))
        print(part, flush=True)
    return json.loads(json.dumps(found))


def difference(old: Any, new: Any) -> float:
    """Largest difference of numbers, relative to the largest of the same list; infinite where the rest differs."""
    if isinstance(old, dict) and isinstance(new, dict):
        return max((difference(old.get(key), new.get(key)) for key in old.keys() | new.keys()), default=0.0)
    if isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            return math.inf
        if old and all(isinstance(value, float | int) for value in [*old, *new]):
            size = max(*map(abs, old), *map(abs, new), 1e-300)
            return max(abs(a - b) / size for a, b in zip(old, new, strict=True))
        return max((difference(a, b) for a, b in zip(old, new, strict=True)), default=0.0)
    if isinstance(old, float | int) and isinstance(new, float | int):
        return abs(old - new) / max(abs(old), abs(new), 1e-300)
    return 0.0 if old == new else math.inf


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    write = commands.add_parser("write", help="compute, with the install that Python finds")
    write.add_argument("out", type=Path)
    write.add_argument("--data", type=Path, help="folder with recordings")
    compare = commands.add_parser("compare", help="two files of the first form")
    compare.add_argument("old", type=Path)
    compare.add_argument("new", type=Path)
    compare.add_argument("--tolerance", type=float, default=1e-12, help="of relative differences")
    options = parser.parse_args()
    if options.command == "write":
        warnings.simplefilter("ignore")
        torch.set_num_threads(1)
        options.out.write_text(json.dumps(computed(options.data)))
        return
    old, new = (json.loads(path.read_text()) for path in (options.old, options.new))
    differs = 0
    for name in sorted(old.keys() | new.keys()):
        size = difference(old.get(name), new.get(name))
        if not size <= options.tolerance:
            differs += 1
            print(f"{size:9.2g}  {name}")
    print(f"{len(old.keys() | new.keys()) - differs} entries the same within {options.tolerance:g}, {differs} not")
    sys.exit(bool(differs))


if __name__ == "__main__":
    main()
