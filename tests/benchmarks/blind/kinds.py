"""The kinds of cases: which effects, on which table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from . import common_noise, filters, forms, marginal, response, shapes, spectral, strange
from .bench import Bench, Part

GROUPS = ("mechanism", "null", "pair", "two", "outside", "unidentifiable")  # and "real", which needs recordings
WIDER = ("form", "common_noise", "fitted", "misfit")  # what users have beside them
SIZELESS = ("quantization_bare", "angle_counts")  # kinds that every single sample proves, whatever size is asked


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
    "tone_in_spells": shapes.tone_in_spells,
    "ring_down": shapes.ring_down,
    "pulses": shapes.pulses,
    "interleaving": shapes.interleaving,
    "interleaved_gain": response.interleaved_gain,
    "chirp": strange.chirp,
    "drifting_tone": shapes.drifting_tone,
    "resonance": spectral.resonance,
    "quadratic_coupling": shapes.quadratic_coupling,
    "low_pass": spectral.low_pass,
    "high_pass": _with(filters.high_pass, designs=filters.BUTTERWORTH),
    "notch": spectral.notch,
    "quantization": marginal.quantization,
    "quantization_bare": marginal.lattice,
    "dead_band": marginal.dead_band,
    "clipping": marginal.clipping,
    "stuck_samples": marginal.stuck_samples,
    "nonlinearity": response.nonlinearity,
    "spikes_shock": _with(marginal.spikes, simultaneous=True),
    "spikes_bus": _with(marginal.spikes, simultaneous=False),
    "variance_change": marginal.variance_change,
    "random_telegraph": spectral.random_telegraph,
    "step": shapes.step,
    "ramp": shapes.ramp,
    "bias_oscillation": shapes.bias_oscillation,
    "temperature_drift": shapes.temperature_drift,
    "warm_up_transient": _with(shapes.warm_up_transient, thermometer="board"),
    "flicker": spectral.power_law,
    "quantization_noise": spectral.quantization_noise,
    "angle_counts": marginal.angle_counts,
    "g_sensitivity": shapes.g_sensitivity,
    "common_mode": spectral.common_mode,
    "cross_talk": spectral.cross_talk,
    "scale_factor": shapes.scale_factor,
    "channel_coupling": shapes.channel_coupling,
    "clock_skew": shapes.clock_skew,
    "clock_lost_samples": _with(shapes.clock_skew, lost=True),
    "time_scale": shapes.time_scale,
    "parameter_shift": spectral.parameter_shift,
    "sensor_gain": spectral.sensor_gain,
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
    "am_noise": _with(strange.modulated_noise, slow=True),
    "hysteresis": strange.hysteresis,
}

_UNIDENTIFIABLE: dict[str, tuple[Callable[[Bench, float], Part], dict[str, Any]]] = {
    "lost_samples": (strange.lost_samples, {"white_only": True}),
    "constant_rate": (_with(shapes.scale_factor, constant=True), {}),
    "alias": (strange.alias, {"share": 1.0}),
}

_FORMS: dict[str, Callable[[Bench, float], Part]] = {
    "filter": filters.low_pass,
    "average": _with(filters.low_pass, design="average"),
    "high_pass": filters.high_pass,
    "band_stop": filters.band_stop,
    "harmonics": forms.harmonics,
    "laplace_noise": strange.laplace_noise,
    "periodic_noise": _with(strange.modulated_noise, slow=False),
    "power_law": _with(spectral.power_law, mechanism="power_law", exponent=1.5),
    "bursts_of_noise": strange.bursts_of_noise,
    "modulated": forms.modulated,
    "rotor": forms.rotor,
    "bursts_of_a_tone": forms.bursts_of_a_tone,
    "curved_temperature": forms.curved_temperature,
    "two_time_constants": forms.two_time_constants,
    "heater": forms.heater,
    "restarted": forms.restarted,
    "handled": forms.handled,
    "thermal_loop": forms.thermal_loop,
    "asymmetric_telegraph": _with(spectral.random_telegraph, asymmetries=(2.2, 3.2)),
    "ramp_of_level": forms.ramp_of_level,
    "level_of_channel": forms.level_of_channel,
    "tone_of_channel": forms.tone_of_channel,
    "several_steps": _with(shapes.step, count=3),
    "several_modes": forms.several_modes,
    "swapped": forms.swapped,
    "simulated_resonance": forms.simulated_resonance,
    "simulated_source": forms.simulated_source,
    "simulated_spikes": forms.simulated_spikes,
    "late_acceleration": forms.late_acceleration,
    "coloured_source": forms.coloured_source,
}

# a noise model that was fitted to an earlier record of the array: by what, to how long a one, of which processes
_RIGHT = "WN + AR1 + RW"
_FITTED: dict[str, dict[str, Any]] = {
    "gmwm": {"by": "gmwm", "share": 1.0},
    "gmwm_short": {"by": "gmwm", "share": 0.25},
    "refined": {"by": "refined", "share": 1.0},
    "array": {"by": "array", "share": 1.0},
    "array_short": {"by": "array", "share": 0.25},
    "jointly": {"by": "jointly", "share": 0.5},
    "ranked": {"by": "ranked", "share": 1.0},
}
_MISFITS = {"no_ar1": "WN + RW", "no_walk": "WN + AR1", "white_alone": "WN"}

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

_LINE = ("line", True)  # that all sensors share and the simulator knows
_OF_RECORD = ("of_record", True)  # whatever number of sensors is drawn to have it
_ON_THE_TABLE: dict[str, tuple[tuple[str, Any], ...]] = {
    "clock_skew": (_LINE,),
    "clock_lost_samples": (_LINE,),
    "time_scale": (_LINE, _OF_RECORD),  # the label is the record's: no sensor has a rate of its own
}
_AS_LONG = ("share", 1.0)  # simulation, in samples
_OF_FORMS: dict[str, tuple[tuple[str, Any], ...]] = {
    "handled": (_OF_RECORD,),  # a device moves as a whole
    "simulated_resonance": (_AS_LONG,),
    "simulated_source": (_AS_LONG,),
    "simulated_spikes": (_AS_LONG,),
}

KINDS: dict[str, Kind] = {
    **{name: Kind("mechanism", (effect,), _ON_THE_TABLE.get(name, ())) for name, effect in _MECHANISMS.items()},
    **{name: Kind("null", (), tuple(options.items())) for name, options in _NULLS.items()},
    **{f"pair:{name}": Kind("pair", (e,), tuple(o.items())) for name, (e, o) in _PAIRS.items()},
    **{f"two:{name}": Kind("two", tuple(_MECHANISMS[part] for part in parts)) for name, parts in _COMBINED.items()},
    **{f"outside:{name}": Kind("outside", (effect,)) for name, effect in _OUTSIDE.items()},
    **{f"form:{name}": Kind("form", (effect,), _OF_FORMS.get(name, ())) for name, effect in _FORMS.items()},
    **{f"common_noise:{law}": Kind("common_noise", (), (("law", law),)) for law in common_noise.LAWS},
    **{
        f"fitted:{name}": Kind("fitted", (), (("fit", {"model": _RIGHT, **options}),))
        for name, options in _FITTED.items()
    },
    **{
        f"misfit:{name}": Kind("misfit", (), (("fit", {"model": model, "by": "gmwm", "share": 1.0}),))
        for name, model in _MISFITS.items()
    },
    **{f"blind:{name}": Kind("unidentifiable", (e,), tuple(o.items())) for name, (e, o) in _UNIDENTIFIABLE.items()},
    **{f"real:{name}": Kind("real", effects) for name, effects in _REAL.items()},
}


def kinds(group: str | None = None) -> list[str]:
    """Names of the kinds, of one group: one of `GROUPS`, of `WIDER`, or real."""
    return [name for name, kind in KINDS.items() if group in (None, kind.group)]
