"""Names of release 0.1 that have moved: they work until 0.3, with a warning that says what took their place.

All of it goes at once, with this file and the lines that import it.
"""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Modules of 0.1, and where their content is. Those named like a public function are not here: as attributes of the
# package they would hide the function.
_MODULES = {
    "array_gmwm": "fitting.array.gmwm",
    "array_gmwm_result": "fitting.array.result",
    "assisted": "fusion.weights.model_assisted",
    "axes": "_base.axes",
    "block_length": "wavelets.block_length",
    "bootstrap": "wavelets.block_bootstrap",
    "cli_fleet": "cli.fleet",
    "cli_mismatch": "cli.diagnose",
    "cli_models": "cli.fit",
    "cli_navigation": "cli.emulate",
    "cli_reading": "cli.options",
    "cli_shared": "cli.options",
    "competitors": "fusion.weights.baselines",
    "covariance": "wavelets.covariance",
    "cross_fitting": "fusion.uncertainty.cross_fitting",
    "demo": "cli.demo.demo",
    "demo_mismatch": "cli.demo.mismatch",
    "demo_models": "cli.demo.models",
    "fault_kinds": "fusion.faults.classify",
    "fleet.standing": "fleet.summary",
    "fleet.watch": "fleet.watchdog",
    "fleet.work": "fleet.run",
    "fleet_run": "fleet.processes",
    "gain": "fusion.uncertainty.variance_reduction",
    "gmwm": "fitting.gmwm",
    "gmwm_result": "fitting.gmwm_result",
    "haar": "wavelets.haar",
    "hypotheses": "fusion.uncertainty.tests",
    "influence": "fusion.uncertainty.influence",
    "intervals": "wavelets.intervals",
    "io.notes": "io.streams",
    "io.resample": "io.align",
    "io.slices": "io.formats.slices",
    "io.stream": "io.streams",
    "joint": "fitting.joint",
    "lightning_module": "fleet.lightning",
    "live": "fusion.live",
    "long_recording": "io.chunked",
    "metric": "wavelets.metric",
    "mismatch.agreement": "mismatch.reporting.discrepancy",
    "mismatch.case": "mismatch.signals.comparison",
    "mismatch.engine": "mismatch.diagnose",
    "mismatch.inputs": "mismatch.repair.inputs",
    "mismatch.judge": "mismatch.reporting.judge",
    "mismatch.mechanism": "mismatch.mechanisms.mechanism",
    "mismatch.outcome": "mismatch.reporting.outcome",
    "mismatch.repaired": "mismatch.repair.repaired_model",
    "mismatch.report": "mismatch.reporting.report",
    "mismatch.saved": "mismatch.repair.serialise",
    "mismatch.side": "mismatch.signals.records",
    "model_words": "fitting.report.words",
    "moment_bootstrap": "fitting.bootstrap",
    "moment_covariance": "fitting.moments.covariance",
    "moment_fit": "fitting.moments.fit",
    "moment_identity": "fitting.moments.identifiability",
    "moment_inference": "fitting.moments.inference",
    "moment_profile": "fitting.moments.profile",
    "multiscale": "fusion.multiscale",
    "multiscale_result": "fusion.multiscale_result",
    "parametric": "fusion.uncertainty.parametric",
    "parity": "fusion.faults.parity",
    "parity_energy": "fusion.faults.residuals",
    "parity_reference": "fusion.faults.reference",
    "parity_result": "fusion.faults.result",
    "parsing": "noise.parsing",
    "pilot": "wavelets.pilot",
    "plotting": "fusion.plots",
    "plotting_fleet": "fleet.plots",
    "plotting_mismatch": "mismatch.reporting.plots",
    "plotting_models": "fitting.plots",
    "plotting_navigation": "navigation.plots",
    "processes": "noise.processes",
    "profile_surfaces": "fitting.moments.profile_objectives",
    "ranking": "fitting.ranking.rank",
    "ranking_result": "fitting.ranking.result",
    "recording": "io.recording",
    "report": "fusion.report.page",
    "report_fleet": "fleet.report",
    "report_mismatch": "mismatch.reporting.page",
    "report_models": "fitting.report.page",
    "report_page": "_base.page",
    "report_ranking": "fitting.report.ranking",
    "report_words": "fusion.report.words",
    "robust": "wavelets.robust",
    "robust_covariance": "fitting.moments.covariance",
    "saturation": "io.saturation",
    "scale_weights": "fusion.weights.svo",
    "selection": "fusion.weights.selection",
    "series": "wavelets.long_run_variance",
    "simulate": "noise.array_model",
    "svo": "fusion.svo",
    "svo_result": "fusion.result",
    "svo_stream": "fusion.streaming",
    "tones": "fitting.spectral.tones",
    "uncertainty": "wavelets.intervals",
    "units": "_base.units",
    "virtual_file": "fusion.streaming",
    "virtual_noise": "fitting.virtual_noise",
    "weights_spread": "fusion.uncertainty.weights",
    "whittle": "fitting.spectral.whittle",
}


class _MovedModules(MetaPathFinder, Loader):
    """Finds a module under its old name."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        package, _, name = fullname.partition(".")
        return spec_from_loader(fullname, self) if package == "gyrofuse" and name in _MODULES else None

    def exec_module(self, module: ModuleType) -> None:
        new = "gyrofuse." + _MODULES[module.__name__.partition(".")[2]]
        warn_deprecated(module.__name__, new)
        sys.modules[module.__name__] = import_module(new)


def find_moved_modules() -> None:
    """Let modules be imported under their old names."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(_MovedModules())


def warn_deprecated(old: str, new: str, stacklevel: int = 2) -> None:
    """Warn that a name goes.

    Args:
        old: The name.
        new: What is to be used in its place.
        stacklevel: Frames between this call and the line that used the name, plus 1.
    """
    warnings.warn(
        f"{old} is deprecated and goes with release 0.3; use {new}", DeprecationWarning, stacklevel=stacklevel + 1
    )


def moved_names(module: str, names: Mapping[str, str], stacklevel: int = 2) -> Callable[[str], Any]:
    """The `__getattr__` of a module that some names have left.

    Args:
        module: Name of the module.
        names: Where each of them is now, as `"package.module.name"`.
        stacklevel: Frames between this function and the line that used the name, plus 1: 3 within a `__getattr__`.
    """

    def get(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home, _, new = names[name].rpartition(".")
        warn_deprecated(f"{module}.{name}", names[name], stacklevel)
        return getattr(import_module(home), new)

    return get


def renamed_arguments(**names: str) -> Callable[[_Function], _Function]:
    """Let a function take keyword arguments by their old names.

    Args:
        **names: New name of each, by its old one.
    """

    def decorate(function: _Function) -> _Function:
        @functools.wraps(function)
        def with_old_names(*arguments: Any, **options: Any) -> Any:
            for old in names.keys() & options.keys():
                if names[old] in options:
                    raise TypeError(f"{function.__qualname__}: `{old}` is the old name of `{names[old]}`: give one")
                warn_deprecated(f"argument `{old}`", f"`{names[old]}`")
                options[names[old]] = options.pop(old)
            return function(*arguments, **options)

        return with_old_names  # type: ignore[return-value]

    return decorate


class RenamedAttribute:
    """An attribute or a method under its old name, in the body of its class: `std = RenamedAttribute("std_err")`."""

    def __init__(self, new: str) -> None:
        self._new = new

    def __set_name__(self, owner: type, name: str) -> None:
        self._old = name

    def __get__(self, instance: Any, owner: type) -> Any:
        warn_deprecated(f"{owner.__name__}.{self._old}", self._new)
        return getattr(owner if instance is None else instance, self._new)
