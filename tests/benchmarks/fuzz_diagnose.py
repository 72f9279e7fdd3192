"""Random diagnoses of random settings, from nothing missing to absurd: what ends in neither a report nor a clear error.

    python tests/benchmarks/fuzz_diagnose.py [--runs 100] [--first 0] [--seconds 200] [--quick]

A run is made by its number alone. One to 24 sensors at 50 to 2000 Hz, recordings from the shortest allowed to 20 000
samples, never a power of two but for the shortest; simulations by samples of any length, or by models of one sensor, of
each, or of an array; with and without channels and units; up to four random effects from hidden to huge; constant
offsets; numbers of 1e-12 to 1e6; float32. Every report has to be told in full: text, JSON, and the same samples of the
repaired simulation and of the one that is read back. `--quick` is up to 6 sensors and 6000 samples.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import gyrofuse as gf
from gyrofuse.mismatch.repair.serialise import repaired_from_dict

Array = NDArray[np.float64]

FEWEST, MOST = 4096, 20_000  # samples of a recording
CLEAR = re.compile(r"`\w+`: ")  # how an error that says what was expected begins


@dataclass(frozen=True)
class Setting:
    """One random diagnosis: what goes in, and a word for each choice.

    Attributes:
        recording, simulation: As `diagnose` takes them.
        options: Its keyword arguments.
        words: Choices, to tell of them.
    """

    recording: Any
    simulation: Any
    options: dict[str, Any]
    words: tuple[str, ...]


class TooLongError(Exception):
    """A run took more time than it was given."""


def too_long(*_: object) -> None:
    raise TooLongError


class Maker:
    """The random numbers of one run."""

    def __init__(self, number: int, *, quick: bool) -> None:
        self.rng = np.random.default_rng([20, number])
        self.n_sensors = int(np.exp(self.rng.uniform(0, np.log(7 if quick else 25))))
        self.n_samples = self.length(6000 if quick else MOST)
        self.rate = float(np.exp(self.rng.uniform(np.log(50), np.log(2000))))
        self.words: list[str] = [f"{self.n_sensors} sensors", f"{self.n_samples} samples", f"{self.rate:.4g} Hz"]

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def length(self, most: int) -> int:
        """Log-uniform, the shortest allowed once in five; a power of two but for that one never."""
        if self.chance(0.2):
            return FEWEST
        n = int(np.exp(self.rng.uniform(np.log(FEWEST), np.log(most))))
        return n + 1 if n & (n - 1) == 0 else n

    def noise(self, n: int, n_sensors: int) -> Array:
        """White, coloured and slow noise, in part shared."""
        own = self.rng.standard_normal((n_sensors, n)) * np.exp(self.rng.uniform(-1, 1, (n_sensors, 1)))
        walk = np.cumsum(self.rng.standard_normal((n_sensors, n)), -1) * 10 ** self.rng.uniform(-5, -1)
        shared = self.rng.standard_normal(n) * self.rng.uniform(0, 1) * self.chance(0.5)
        return own + walk + shared

    def channels(self) -> dict[str, torch.Tensor]:
        n = self.n_samples
        names = {
            "temperature": lambda: 25 + np.cumsum(self.rng.standard_normal(n)) * 1e-3,
            "acceleration": lambda: np.array([[0.0], [0.0], [1.0]]) + 0.01 * self.rng.standard_normal((3, n)),
            "reference_rate": lambda: self.rng.standard_normal(n),
            "file": lambda: np.full(n, 1.0),
            "accel[broken]": lambda: np.where(self.rng.random(n) < 0.01, np.nan, 0.0),
        }
        chosen = [name for name in names if self.chance(0.35)]
        return {name: torch.from_numpy(np.asarray(names[name]())) for name in chosen}

    def effect(self, x: Array, channels: dict[str, torch.Tensor]) -> Array:
        """One random effect of a strength between hidden and huge, in random sensors."""
        kinds = ("tone", "step", "spikes", "rounding", "clipping", "stuck", "filter", "louder", "walk", "common")
        kind = str(self.rng.choice([*kinds, "telegraph", "band", "chirp", "unit", "channel", "dead", "burst"]))
        size = 10 ** self.rng.uniform(-2, 4) * float(np.median(np.diff(x).std(-1)))
        which = self.rng.random(len(x)) < self.rng.choice([0.3, 1.0])
        which[self.rng.integers(len(x))] = True
        self.words.append(f"{kind} of {size:.2g} in {which.sum()}")
        n, t = x.shape[-1], np.arange(x.shape[-1])
        f, y = self.rng.uniform(0, 0.5), x[which]
        if kind == "tone":
            y = y + size * np.cos(2 * np.pi * f * t + self.rng.uniform(0, 7, (len(y), 1)))
        elif kind == "step":
            y = y + size * (t > self.rng.integers(n))
        elif kind == "spikes":
            y = y + size * (self.rng.random(y.shape) < 10 ** self.rng.uniform(-4, -1)) * self.rng.standard_normal(n)
        elif kind == "rounding":
            y = size * np.round(y / size)
        elif kind == "clipping":
            y = np.clip(y, *np.quantile(y, [0.5 - 0.5 * self.rng.random(), 0.6 + 0.4 * self.rng.random()]))
        elif kind == "stuck":
            source = np.where(self.rng.random(n) < self.rng.uniform(0, 0.9), 0, t)
            y = y[:, np.maximum.accumulate(source)]
        elif kind == "filter":
            width = int(self.rng.integers(2, 50))
            y = np.stack([np.convolve(row, np.full(width, 1 / width), "same") for row in y])
        elif kind == "louder":
            y = np.where((t // max(n // int(self.rng.integers(2, 20)), 1)) % 2 > 0, y * (1 + size), y)
        elif kind == "walk":
            y = y + size * np.cumsum(self.rng.standard_normal(y.shape), -1) / 100
        elif kind == "common":
            y = y + size * self.rng.standard_normal(n)
        elif kind == "telegraph":
            y = y + size * (np.cumsum(self.rng.random(n) < 10 ** self.rng.uniform(-3, -1)) % 2)
        elif kind == "band":
            phase = 2 * np.pi * np.cumsum(f + 10 ** self.rng.uniform(-4, -1) * self.rng.standard_normal(n))
            y = y + size * np.cos(phase)
        elif kind == "chirp":
            y = y + size * np.cos(2 * np.pi * (f * t + self.rng.uniform(-0.2, 0.2) * t**2 / n))
        elif kind == "unit":
            y = y * float(self.rng.choice([math.degrees(1), 3600, 1e3]))
        elif kind == "channel" and channels:
            path = np.asarray(self.rng.choice(list(channels)) and next(iter(channels.values()))).reshape(-1, n)[0]
            y = y + size * np.nan_to_num(path)
        elif kind == "dead":
            y = np.where(np.abs(y - y.mean(-1, keepdims=True)) < size, 0.0, y)
        elif kind == "burst":
            start = int(self.rng.integers(n - 50))
            y = y.copy()
            y[:, start : start + int(self.rng.integers(1, 50))] += size
        x = x.copy()
        x[which] = y
        return x

    def model(self, scale: float) -> Any:
        """A noise model: of one sensor, with numbers for each, or of an array."""
        kind = str(self.rng.choice(["one", "each", "array"]))
        own = [
            gf.WhiteNoise(float(np.exp(self.rng.uniform(-1, 1)) * scale**2))
            + gf.AR1(float(self.rng.uniform(0.5, 0.999)), float(0.01 * scale**2))
            for _ in range(self.n_sensors)
        ]
        self.words.append(f"model of {kind}")
        if kind == "one":
            return own[0]
        if kind == "each":
            return own[0].with_params(torch.stack([model.params for model in own]))
        return gf.ArrayModel.from_sensors(own)


def setting(number: int, *, quick: bool) -> Setting:
    """The diagnosis of a number."""
    m = Maker(number, quick=quick)
    scale = 10 ** float(m.rng.uniform(-12, 6))
    channels = m.channels() if m.chance(0.5) else {}
    x = m.noise(m.n_samples, m.n_sensors)
    for _ in range(int(m.rng.integers(0, 5))):
        x = m.effect(x, channels)
    if m.chance(0.4):
        x = x + 10 ** m.rng.uniform(0, 6) * m.rng.standard_normal((m.n_sensors, 1))
        m.words.append("offsets")
    dtype = torch.float32 if m.chance(0.2) else torch.float64
    signal = torch.from_numpy(x * scale).to(dtype)
    m.words += [f"scale {scale:.1e}", str(dtype)]
    unit = str(m.rng.choice(["deg/s", "rad/s", "counts", "unknown"]))
    options: dict[str, Any] = {"generator": torch.Generator().manual_seed(number)} if m.chance(0.3) else {}
    recording: Any = signal
    if channels or m.chance(0.5):
        recording = gf.Recording(signal, rate=m.rate, unit=unit, channels=channels)
        m.words.append(f"{unit} with {', '.join(channels) or 'no channels'}")
    else:
        options["rate"] = m.rate
    if m.chance(0.4):
        simulation = m.model(scale)
    else:
        n = m.n_samples if m.chance(0.4) else m.length(2 * MOST)
        drawn = m.noise(n, m.n_sensors)
        if m.chance(0.2):
            drawn = m.effect(drawn, {})
        simulation = torch.from_numpy(drawn * scale)
        m.words.append(f"simulation of {n}")
        if isinstance(recording, gf.Recording) and m.chance(0.5):
            simulation = gf.Recording(simulation, rate=m.rate, unit=unit)
    return Setting(recording, simulation, options, tuple(m.words))


def outcome(given: Setting) -> str:
    """Word for what became of a diagnosis; raises what is neither a report nor a clear error."""
    try:
        report = gf.diagnose(given.recording, given.simulation, **given.options)
    except (ValueError, TypeError) as error:
        if not CLEAR.match(str(error)):
            raise
        return f"refused: {str(error)[:70]}"
    str(report)
    plain = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    report.correct(given.recording)
    model = repaired_from_dict(plain["model"])
    n = report.recording.shape[-1]
    drawn = [
        m.simulate(n, channels=report.case.info.channels, generator=torch.Generator().manual_seed(1))
        for m in (model, report.model)
    ]
    if not bool(drawn[0].isfinite().all()):
        raise ArithmeticError("the repaired simulation is not finite")
    if not torch.equal(*drawn):
        raise ArithmeticError("the repaired simulation that was read back simulates something else")
    return "mismatch" if report.mismatch else "agree"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seconds", type=float, default=math.inf, help="no run is begun after so many")
    parser.add_argument("--each", type=float, default=120.0, help="seconds of processor time that a run may take")
    parser.add_argument("--quick", action="store_true", help="few sensors, short recordings")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    signal.signal(signal.SIGPROF, too_long)
    start, counts, failed = time.monotonic(), Counter[str](), []
    for number in range(arguments.first, arguments.first + arguments.runs):
        if time.monotonic() - start > arguments.seconds:
            break
        given, began = setting(number, quick=arguments.quick), time.monotonic()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            signal.setitimer(signal.ITIMER_PROF, arguments.each)
            try:
                word = outcome(given)
            except TooLongError:
                word = f"not done in {arguments.each:g} s"
            except Exception as error:  # whatever it is: it is what is looked for
                word = f"FAILED {type(error).__name__}"
                failed.append(number)
                sys.stderr.write(f"--- {number}: {'; '.join(given.words)}\n{traceback.format_exc()}\n")
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
        counts[word.split(":")[0]] += 1
        print(f"{number:5d} {time.monotonic() - began:6.1f} s  {word}  ({'; '.join(given.words)})", flush=True)
    print(f"{sum(counts.values())} runs: {dict(counts)}; failed: {failed}")
    return len(failed) > 0


if __name__ == "__main__":
    sys.exit(main())
