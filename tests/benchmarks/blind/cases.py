"""The cases of the blind proof.

case = make_case("resonance", 30.0, seed=7)
case.recording    what the analyst is given: gyro (sensor, time), fs, unit, channels
case.simulation   {"gyro", "fs", "unit"} or {"terms": one list of processes per sensor}
case.truth        what the judge is given, sealed
"""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import common_noise, field, mechanics, shapes, thermal
from .analog import Base, consumer_base
from .bench import Bench, Part
from .converter import round_to_lattice
from .kinds import KINDS, Kind, kinds
from .likelihood import within
from .setting import Setting, drawn

Array = NDArray[np.float64]
RATE = 200.0
NATS = (3.0, 10.0, 30.0, 100.0)
STRONG = (300.0, 3_000.0, 30_000.0, 300_000.0)  # nats
MOST_AT_REST = 5.0  # deg/s, standard deviation: beyond, a gyroscope at rest is broken


class Case(NamedTuple):
    """A recording, the simulation that is to explain it, and the truth."""

    recording: dict[str, Any]
    simulation: dict[str, Any]
    truth: dict[str, Any]


def make_case(
    kind: str,
    nats: float | None,
    seed: int,
    *,
    n_samples: int = 65536,
    rate: float = RATE,
    data: Path | None = None,
    wide: bool = False,
) -> Case:
    """One case, the same for the same arguments.

    Args:
        kind: One of `kinds()`.
        nats: Detectability of each effect, 100 if None; nothing to kinds without an effect, and to bare rounding.
        seed: Of all random numbers.
        n_samples: Length of the recording.
        rate: In Hz; real recordings have their own.
        data: Folder of the real recordings, for kinds that need one.
        wide: Whether sensors, rate, length (up to `n_samples`) and the number of sensors concerned are drawn as well.

    Returns:
        Recording, simulation and truth.

    Raises:
        OutOfReachError: An effect cannot have that size on that array.
    """
    if kind not in KINDS:
        raise ValueError(f"`kind`: expected one of {kinds()}, got {kind!r}")
    made = KINDS[kind]
    nats = (100.0 if nats is None else float(nats)) if made.effects else None
    root = np.random.SeedSequence([seed, zlib.crc32(kind.encode()), round(1000 * (nats or 0))])
    of_base, of_effect, of_recording, of_simulation, of_table, of_setting = map(np.random.default_rng, root.spawn(6))
    setting = drawn(n_samples, of_setting) if wide else Setting(n_samples, rate)
    if wide and made.option("of_record"):
        setting = setting._replace(reach="all")
    asked, n_samples, rate = {"n_samples": n_samples, "rate": rate, "wide": wide}, setting.n_samples, setting.rate
    real = None
    if made.group == "real":
        if data is None:
            raise ValueError(f"`data`: expected a folder with {', '.join(field.FILES)} for {kind}, got none")
        real = field.background(data, n_samples, of_base)
        rate = real.rate
    base = field.measured_base(real.recording, rate) if real else _base(made, of_base, setting)
    share = None if real else _share(made, of_simulation, setting)
    bench = Bench(base, n_samples, of_effect, share or math.inf, setting.reach)
    parts = [effect(bench, nats) for effect in made.effects if nats is not None]

    if real:
        # Within its step any value may have been rounded to what the device gave.
        analog = real.recording + real.step[:, None] * of_recording.uniform(-0.5, 0.5, real.recording.shape)
        gyro, llrs = _converted(bench, parts, analog, real.step[:, None])
        simulation: dict[str, Any] = {"gyro": real.simulation, "fs": rate, "unit": "deg/s"}
        channels: dict[str, Array] = {}
    elif made.option("law"):
        gyro, llrs = common_noise.simulated(made.option("law"), base, n_samples, of_recording), []
        assert share is not None
        simulated = common_noise.simulated(made.option("law"), base, int(share * n_samples), of_simulation)
        simulation, channels = {"gyro": simulated, "fs": rate, "unit": "deg/s"}, {}
    elif made.option("fit"):
        gyro, llrs = _record(bench, parts, of_recording)
        simulation, channels = _earlier(bench, made.option("fit"), of_simulation), {}
    else:
        gyro, llrs = _record(bench, parts, of_recording)
        simulation = _simulation(bench, parts, share, of_simulation)
        channels = _channels(made, bench, of_table)
    for part in parts:
        channels |= part.channels
    if made.option("known_tone"):
        nu, amplitude = of_table.uniform(0.05, 0.45), 0.2 * float(bench.sigma.mean())
        gyro = gyro + shapes.common_line(n_samples, nu, amplitude, of_table)
        simulation["gyro"] = simulation["gyro"] + shapes.common_line(
            simulation["gyro"].shape[-1], nu, amplitude, of_table
        )
    if made.option("lattice"):
        gyro = round_to_lattice(gyro, made.option("lattice"))
        simulation["gyro"] = round_to_lattice(simulation["gyro"], made.option("lattice"))
    within("an output at rest", float(gyro.std(axis=1).max()), MOST_AT_REST, "deg/s")
    recording = {"gyro": gyro, "fs": rate, "unit": "deg/s", **channels}
    effects = [effect_truth(part, llr) for part, llr in zip(parts, llrs, strict=True)]
    finite = all(part.oracle_law != "certain" for part in parts)
    truth = {
        "kind": kind,
        "group": made.group,
        "seed": seed,
        "nats": nats,
        "asked": asked,
        "n_samples": n_samples,
        "rate_hz": rate,
        "n_sensors": len(gyro),
        "reach": setting.reach,
        "base": None if real else bench.base.terms(),
        "simulated": simulation["gyro"].shape[-1] if "gyro" in simulation else None,
        "effects": effects,
        "true_gain": float(sum(llrs)) if parts and finite else None,
    }
    return Case(recording, simulation, truth)


def _base(made: Kind, rng: np.random.Generator, setting: Setting) -> Base:
    base = consumer_base(rng, setting.rate, setting.n_sensors, relaxators=1 if made.option("fit") else None)
    if made.option("phi"):
        phi = np.full((len(base.white), 1), made.option("phi"))
        base = replace(base, phi=phi, variance=4 * base.white[:, None] * 1e-3 * (1 - phi**2))
    if made.option("white_only"):
        base = replace(base, variance=1e-12 * base.variance, walk=1e-12 * base.walk)
    return base


def _record(bench: Bench, parts: list[Part], rng: np.random.Generator) -> tuple[Array, list[float]]:
    """The chain from physics to numbers, and each effect's log likelihood ratio with the others known."""
    physics = next((part.base for part in parts if part.base is not None), bench.base)
    analog = physics.analog(bench.n, rng)
    for part in parts:
        if part.analog is not None:
            analog = part.analog(analog)
    return _converted(bench, parts, bench.sampled(analog))


def _converted(bench: Bench, parts: list[Part], gyro: Array, step: Array | None = None) -> tuple[Array, list[float]]:
    """What parts add to a sampled signal and its converter makes of it, and each one's log likelihood ratio.

    Args:
        step: Of a device's own converter, `(sensor, 1)`.
    """
    for part in parts:
        if part.signal is not None:
            gyro = gyro + part.signal
    for part in parts:
        if part.converter is not None:
            gyro = part.converter(gyro)
    if step is not None:
        gyro = round_to_lattice(gyro, step)
    llrs = []
    for part in parts:
        others = [other.signal for other in parts if other is not part and other.signal is not None]
        llrs.append(part.llr(gyro - np.sum(others, axis=0) if others else gyro))
    return gyro, llrs


def _share(made: Kind, rng: np.random.Generator, setting: Setting) -> float | None:
    """Length of the simulation over that of the recording; None for a model, which has no samples."""
    draws = rng.uniform(size=2)
    samples = any(made.option(name) for name in ("line", "lattice", "known_tone", "share", "law"))  # what no model has
    if made.option("as_model") or (not samples and draws[0] < 0.25):
        return None
    return made.option("share") or float(setting.shares[int(3 * draws[1])])


def _earlier(bench: Bench, fit: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Earlier records of the same array, and how a noise model is to be fitted to them."""
    count = 2 if fit["by"] == "jointly" else 1
    earlier = [bench.base.simulate(int(fit["share"] * bench.n), rng) for _ in range(count)]
    return {"gyro": earlier[0], "more": earlier[1:], "fs": bench.rate, "unit": "deg/s", "fit": fit}


def _simulation(bench: Bench, parts: list[Part], share: float | None, rng: np.random.Generator) -> dict[str, Any]:
    if share is None:
        return {"terms": bench.base.terms()}
    gyro = bench.base.simulate(int(share * bench.n), rng)
    for part in parts:
        if part.simulation is not None:
            gyro = part.simulation(gyro)
    return {"gyro": gyro, "fs": bench.rate, "unit": "deg/s"}


def _channels(made: Kind, bench: Bench, rng: np.random.Generator) -> dict[str, Array]:
    """Auxiliary channels that have nothing to do with the gyroscopes, in about half of the cases."""
    wanted = made.option("channels") or ("smooth" if rng.uniform() < 0.5 else None)
    if wanted == "smooth":
        room = thermal.room(bench.n, bench.rate, rng)
        return {"temperature": thermal.thermometer(thermal.box(room, bench.rate, 6.0, 60.0), rng)}
    if wanted == "wandering":
        return {"temperature": 22 + np.cumsum(rng.standard_normal(bench.n)) * 2 / np.sqrt(bench.n)}
    if wanted == "vibrating":
        acceleration = bench.sampled(mechanics.floor_vibration(bench.steps, bench.step_rate, rng))
        return {"acceleration": acceleration + 2e-4 * np.sqrt(bench.rate) * rng.standard_normal(acceleration.shape)}
    return {}


def effect_truth(part: Part, llr: float) -> dict[str, Any]:
    """What the judge is told of one effect."""
    expected = part.nats if part.oracle_nats is None else part.oracle_nats
    kept = [k for k, i in enumerate(part.sensors) if part.affected is None or i in part.affected]
    parameters = {
        name: said | {"per_sensor": [said["per_sensor"][k] for k in kept]} if "per_sensor" in said else said
        for name, said in part.parameters.items()
    }
    return {
        "mechanism": part.mechanism,
        "class": sorted({part.mechanism, *part.look_alikes}),
        "sensors": [part.sensors[k] for k in kept],
        "sensor_nats": [part.sensor_nats[k] for k in kept if part.sensor_nats],
        "nats": part.nats,
        "oracle_llr": llr,
        "oracle_law": part.oracle_law,
        "oracle_nats": expected,
        "oracle_null": list(part.oracle_null or (-expected, 2 * expected, 0.0)),
        "frequency_hz": part.frequency_hz,
        "frequency_sd_hz": part.frequency_sd_hz,
        "time_s": part.time_s,
        "onset_sd_s": part.onset_sd_s,
        "channel": part.channel,
        "parameters": parameters,
        "form": part.form,
    }
