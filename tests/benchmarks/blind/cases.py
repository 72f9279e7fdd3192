"""The cases of the blind proof.

case = make_case("resonance", 30.0, seed=7)
case.recording    what the analyst is given: gyro (sensor, time), fs, unit, channels
case.simulation   {"gyro", "fs", "unit"} or {"terms": one list of processes per sensor}
case.truth        what the judge is given, sealed
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import field, marginal, mechanics, shapes, spectral, strange, thermal
from .analog import Base, consumer_base
from .bench import Bench, Part
from .converter import round_to_lattice

Array = NDArray[np.float64]
RATE = 200.0
NATS = (3.0, 10.0, 30.0, 100.0)
GROUPS = ("mechanism", "null", "pair", "two", "outside", "unidentifiable")  # and "real", which needs recordings


class Case(NamedTuple):
    """A recording, the simulation that is to explain it, and the truth."""

    recording: dict[str, Any]
    simulation: dict[str, Any]
    truth: dict[str, Any]


@dataclass(frozen=True)
class Kind:
    """A kind of case: its group, the effects, and what else lies on the table; the group "real" has real noise."""

    group: str
    effects: tuple[Callable[[Bench, float], Part], ...] = ()
    options: tuple[tuple[str, Any], ...] = ()

    def option(self, name: str) -> Any:
        return dict(self.options).get(name)


def _with(effect: Callable[..., Part], **settings: Any) -> Callable[[Bench, float], Part]:
    return lambda bench, nats: effect(bench, nats, **settings)


_MECHANISMS: dict[str, Callable[[Bench, float], Part]] = {
    "vibration_tone": shapes.vibration_tone,
    "drifting_tone": shapes.drifting_tone,
    "resonance": spectral.resonance,
    "quadratic_coupling": shapes.quadratic_coupling,
    "low_pass": spectral.low_pass,
    "quantization": marginal.quantization,
    "quantization_bare": marginal.lattice,
    "dead_band": marginal.dead_band,
    "clipping": marginal.clipping,
    "stuck_samples": marginal.stuck_samples,
    "spikes_shock": _with(marginal.spikes, simultaneous=True),
    "spikes_bus": _with(marginal.spikes, simultaneous=False),
    "variance_change": marginal.variance_change,
    "random_telegraph": spectral.random_telegraph,
    "step": shapes.step,
    "temperature_drift": shapes.temperature_drift,
    "warm_up_transient": _with(shapes.warm_up_transient, thermometer="board"),
    "flicker": spectral.power_law,
    "g_sensitivity": shapes.g_sensitivity,
    "common_mode": spectral.common_mode,
    "scale_factor": shapes.scale_factor,
    "clock_skew": shapes.clock_skew,
    "clock_lost_samples": _with(shapes.clock_skew, lost=True),
    "parameter_shift": spectral.parameter_shift,
}

_NULLS: dict[str, dict[str, Any]] = {
    "null": {},
    "null_model": {"as_model": True},
    "null_slow_ar1": {"phi": 0.99999},
    "null_short_simulation": {"share": 0.5},
    "null_long_simulation": {"share": 4.0},
    "null_smooth_channel": {"channels": "smooth"},
    "null_wandering_channel": {"channels": "wandering"},
    "null_vibrating_channel": {"channels": "vibrating"},
    "null_known_tone": {"known_tone": True},
    "null_shared_lattice": {"lattice": 0.0305},
    "null_white_only": {"white_only": True},
}

# each member of a pair is what the other one is mistaken for
_PAIRS: dict[str, tuple[Callable[[Bench, float], Part], dict[str, Any]]] = {
    "telegraph_not_ar1": (_with(spectral.random_telegraph, dwell_share=1 / 150), {}),
    "ar1_not_telegraph": (_with(spectral.parameter_shift, only="ar1"), {}),
    "steps_not_walk": (_with(shapes.step, count=8), {}),
    "walk_not_steps": (_with(spectral.parameter_shift, only="walk"), {}),
    "spikes_not_white": (_with(marginal.spikes, simultaneous=False), {}),
    "white_not_spikes": (_with(spectral.parameter_shift, only="white"), {}),
    "tone_not_wander": (shapes.vibration_tone, {}),
    "wander_not_resonance": (shapes.drifting_tone, {}),
    "resonance_not_wander": (spectral.resonance, {}),
    "flicker_not_ar1": (spectral.power_law, {}),
    "temperature_not_walk": (shapes.temperature_drift, {}),
    "walk_not_temperature": (_with(spectral.parameter_shift, only="walk"), {"channels": "smooth"}),
    "warm_up_not_temperature": (_with(shapes.warm_up_transient, thermometer="board"), {}),
    "warm_up_or_temperature": (_with(shapes.warm_up_transient, thermometer="die"), {}),
    "low_pass_not_level": (spectral.low_pass, {}),
    "level_not_low_pass": (_with(spectral.parameter_shift, only="white"), {}),
    "bursts_not_spikes": (_with(marginal.variance_change, episodes=40), {}),
    "tone_not_quadratic": (shapes.tone_beside_shaking, {}),
    "common_not_g": (spectral.common_mode, {"channels": "vibrating"}),
    "g_not_common": (shapes.g_sensitivity, {}),
}

_COMBINED: dict[str, tuple[str, str]] = {
    "tone+step": ("vibration_tone", "step"),
    "temperature+spikes": ("temperature_drift", "spikes_bus"),
    "resonance+warm_up": ("resonance", "warm_up_transient"),
    "g+telegraph": ("g_sensitivity", "random_telegraph"),
    "flicker+tone": ("flicker", "vibration_tone"),
    "step+variance": ("step", "variance_change"),
    "rounding+tone": ("quantization_bare", "vibration_tone"),
    "low_pass+drifting_tone": ("low_pass", "drifting_tone"),
}

_OUTSIDE: dict[str, Callable[[Bench, float], Part]] = {
    "chirp": strange.chirp,
    "laplace_noise": strange.laplace_noise,
    "cyclostationary_noise": _with(strange.modulated_noise, slow=False),
    "am_noise": _with(strange.modulated_noise, slow=True),
    "hysteresis": strange.hysteresis,
    "power_1.5": _with(spectral.power_law, mechanism="power_1.5", exponent=1.5),
}

_UNIDENTIFIABLE: dict[str, tuple[Callable[[Bench, float], Part], dict[str, Any]]] = {
    "lost_samples": (strange.lost_samples, {"white_only": True}),
    "constant_rate": (_with(shapes.scale_factor, constant=True), {}),
    "alias": (strange.alias, {"share": 1.0}),
}

_REAL: dict[str, tuple[Callable[[Bench, float], Part], ...]] = {
    "untouched": (),
    "vibration_tone": (shapes.vibration_tone,),
    "step": (shapes.step,),
    "temperature_drift": (shapes.temperature_drift,),
    "warm_up_transient": (_with(shapes.warm_up_transient, thermometer="board"),),
    "g_sensitivity": (shapes.g_sensitivity,),
    "scale_factor": (shapes.scale_factor,),
    "spikes": (_with(marginal.spikes, simultaneous=False),),
}

KINDS: dict[str, Kind] = {
    **{
        name: Kind("mechanism", (effect,), (("line", True),) if name.startswith("clock") else ())
        for name, effect in _MECHANISMS.items()
    },
    **{name: Kind("null", (), tuple(options.items())) for name, options in _NULLS.items()},
    **{f"pair:{name}": Kind("pair", (e,), tuple(o.items())) for name, (e, o) in _PAIRS.items()},
    **{f"two:{name}": Kind("two", tuple(_MECHANISMS[part] for part in parts)) for name, parts in _COMBINED.items()},
    **{f"outside:{name}": Kind("outside", (effect,)) for name, effect in _OUTSIDE.items()},
    **{f"blind:{name}": Kind("unidentifiable", (e,), tuple(o.items())) for name, (e, o) in _UNIDENTIFIABLE.items()},
    **{f"real:{name}": Kind("real", effects) for name, effects in _REAL.items()},
}


def kinds(group: str | None = None) -> list[str]:
    """Names of the kinds, of one group: mechanism, null, pair, two, outside, unidentifiable, real."""
    return [name for name, kind in KINDS.items() if group in (None, kind.group)]


def make_case(
    kind: str, nats: float | None, seed: int, *, n_samples: int = 65536, rate: float = RATE, data: Path | None = None
) -> Case:
    """One case, the same for the same arguments.

    Args:
        kind: One of `kinds()`.
        nats: Detectability of each effect, 100 if None; nothing to kinds without an effect, and to bare rounding.
        seed: Of all random numbers.
        n_samples: Length of the recording.
        rate: In Hz; real recordings have their own.
        data: Folder of the real recordings, for kinds that need one.

    Returns:
        Recording, simulation and truth.
    """
    if kind not in KINDS:
        raise ValueError(f"`kind`: expected one of {kinds()}, got {kind!r}")
    made = KINDS[kind]
    nats = (100.0 if nats is None else float(nats)) if made.effects else None
    root = np.random.SeedSequence([seed, zlib.crc32(kind.encode()), round(1000 * (nats or 0))])
    of_base, of_effect, of_recording, of_simulation, of_table = map(np.random.default_rng, root.spawn(5))
    real = None
    if made.group == "real":
        if data is None:
            raise ValueError(f"`data`: expected a folder with {', '.join(field.FILES)} for {kind}, got none")
        real = field.background(data, n_samples, of_base)
        rate = real.rate
    base = field.measured_base(real.recording, rate) if real else _base(made, of_base, rate)
    share = None if real else _share(made, of_simulation)
    bench = Bench(base, n_samples, of_effect, share or math.inf)
    parts = [effect(bench, nats) for effect in made.effects if nats is not None]

    if real:
        # Within its step any value may have been rounded to what the device gave.
        analog = real.recording + real.step[:, None] * of_recording.uniform(-0.5, 0.5, real.recording.shape)
        gyro, llrs = _converted(bench, parts, analog, real.step[:, None])
        simulation: dict[str, Any] = {"gyro": real.simulation, "fs": rate, "unit": "deg/s"}
        channels: dict[str, Array] = {}
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
    recording = {"gyro": gyro, "fs": rate, "unit": "deg/s", **channels}
    effects = [effect_truth(part, llr) for part, llr in zip(parts, llrs, strict=True)]
    finite = all(part.oracle_law != "certain" for part in parts)
    truth = {
        "kind": kind,
        "group": made.group,
        "seed": seed,
        "nats": nats,
        "n_samples": n_samples,
        "rate_hz": rate,
        "base": None if real else bench.base.terms(),
        "simulated": simulation["gyro"].shape[-1] if "gyro" in simulation else None,
        "effects": effects,
        "true_gain": float(sum(llrs)) if parts and finite else None,
    }
    return Case(recording, simulation, truth)


def _base(made: Kind, rng: np.random.Generator, rate: float) -> Base:
    base = consumer_base(rng, rate)
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


def _share(made: Kind, rng: np.random.Generator) -> float | None:
    """Length of the simulation over that of the recording; None for a model, which has no samples."""
    draws = rng.uniform(size=2)
    samples = any(made.option(name) for name in ("line", "lattice", "known_tone", "share"))  # what no model has
    if made.option("as_model") or (not samples and draws[0] < 0.25):
        return None
    return made.option("share") or float(np.array([1.0, 2.0, 4.0])[int(3 * draws[1])])


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
    }
