"""Summary of a fleet: failed logs, noisy sensors, outlying logs, weights with a trend."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from gyrofuse._base.deprecation import RenamedAttribute, moved_names
from gyrofuse._base.results import counted
from gyrofuse.fitting.j_test import REJECTED
from gyrofuse.fleet.store.table import identity_in

# Allan deviation of a sensor, in units of the median of its array, above which it is listed as noisy: a convention.
NOISY = 2.0
# Distance from the median of the logs, in robust standard deviations (median absolute deviation), above which a log is
# an outlier: a normal variable exceeds five with probability 6e-7.
_OUTLIER = 5.0
# Fewest logs of one array for a median and a robust standard deviation to mean anything: of five, two may be outliers.
_FEWEST = 5
# Fewest logs of one array for a test of trend: with eight the smallest two-sided p value of Kendall's test is 2 / 8!,
# below 1e-4, so that a correction for up to 200 weights leaves it significant.
FEWEST_IN_TIME = 8
# Significance level of the test of trend, for all weights together (Bonferroni), and of p values in figures.
LEVEL = 0.01
GAIN = "Allan deviation of the plain mean over that of the virtual gyro, geometric mean over averaging times"


class NoisySensor(NamedTuple):
    """A sensor, and its Allan deviation over that of the median sensor of its array, as the median over its logs."""

    array: str
    sensor: str
    relative_noise: float
    n_logs: int


class Outlier(NamedTuple):
    """An outlying log: the quantity, its value here and in the median log, and their robust standardized distance."""

    log: str
    axis: str | None
    what: str
    value: float
    usual: float
    deviations: float


class WeightWarning(NamedTuple):
    """A log whose weights are unreliable, and the reason: motion, or too short a recording."""

    log: str
    axis: str | None
    why: str


class WeightTrend(NamedTuple):
    """A weight with a monotonic trend over the logs.

    Attributes:
        array: Name of the array.
        sensor: Name of the sensor.
        first: Median weight in the first third of the logs.
        last: Median weight in the last third of the logs.
        tau: Kendall's rank correlation of weight and order of the logs.
        p_value: p value of tau, corrected for the number of weights tested (Bonferroni).
    """

    array: str
    sensor: str
    first: float
    last: float
    tau: float
    p_value: float


@dataclass(frozen=True)
class FleetSummary:
    """Summary of the table of a fleet.

    Attributes:
        task: `"fuse"`, `"fit"` or `"diagnose"`.
        n_logs: Number of logs.
        failures: Logs that failed, and the reasons.
        ranked: Rows of arrays or sensors with the number that they are ranked by: gain of the virtual gyro, largest
            first, or p value of the J test or of the diagnosis, smallest first.
        noisy: Sensors with their relative noise, largest first.
        outliers: Outlying logs, the largest distance first.
        weight_warnings: Logs whose weights are unreliable.
        trends: Weights with a trend, the smallest p value first.
        mechanisms: Number of logs with each mechanism, and with unexplained differences.
    """

    task: str
    n_logs: int
    failures: tuple[tuple[str, str], ...]
    ranked: tuple[tuple[float, Mapping[str, Any]], ...]
    noisy: tuple[NoisySensor, ...]
    outliers: tuple[Outlier, ...]
    weight_warnings: tuple[WeightWarning, ...]
    trends: tuple[WeightTrend, ...]
    mechanisms: tuple[tuple[str, int], ...]

    doubts = RenamedAttribute("weight_warnings")
    drifts = RenamedAttribute("trends")
    n_doubted = RenamedAttribute("n_warned")

    @property
    def values(self) -> list[float]:
        """The finite numbers that rows are ranked by."""
        return [value for value, _ in self.ranked if np.isfinite(value)]

    @property
    def too_noisy(self) -> tuple[NoisySensor, ...]:
        """Sensors more than `NOISY` times as noisy as the median of their array."""
        return tuple(sensor for sensor in self.noisy if sensor.relative_noise > NOISY)

    @property
    def n_refused(self) -> int:
        """Number of fits that the J test rejects."""
        return sum(value < REJECTED for value in self.values)

    @property
    def n_unidentified(self) -> int:
        """Number of fits with parameters that are not identified."""
        return sum(row.get("identified") is False for _, row in self.ranked)

    @property
    def n_warned(self) -> int:
        """Number of logs whose weights are unreliable."""
        return len({warning.log for warning in self.weight_warnings})

    @property
    def n_differ(self) -> int:
        """Number of recordings that differ from their simulation."""
        return sum(bool(row["mismatch"]) for _, row in self.ranked)

    def summary(self) -> str:
        """Summary in a few lines."""
        lines = [f"{self.n_logs} logs, {len(self.failures)} failed"]
        if self.task == "fuse" and self.values:
            lines.append(
                f"{GAIN}: median {np.median(self.values):.3g}, {min(self.values):.3g} to {max(self.values):.3g}; "
                "below 1 is worse than the plain mean"
            )
        if self.task == "fit":
            lines.append(f"{self.n_refused} of {len(self.ranked)} fits refused by the J test at {REJECTED:g}")
            if self.n_unidentified:
                lines.append(
                    f"{self.n_unidentified} of {len(self.ranked)} fits have parameters that cannot be told apart"
                )
        if self.task == "diagnose":
            lines.append(f"{self.n_differ} of {len(self.ranked)} differ")
        lines += [f"  {name}: {count} logs" for name, count in self.mechanisms]
        lines += [
            f"noisy: sensor {s.sensor} of {s.array}, {s.relative_noise:.3g} times its array's median, {s.n_logs} logs"
            for s in self.too_noisy[:3]
        ]
        lines += [
            f"unlike the others: {_place(o)}, {o.what} {o.value:.3g} where {o.usual:.3g} is usual"
            for o in self.outliers[:3]
        ]
        if self.weight_warnings:
            lines.append(f"weights to doubt: {counted(self.n_warned, 'log')}")
        lines += [f"  {_place(warning)}: {warning.why}" for warning in self.weight_warnings[:3]]
        lines += [
            f"trend: weight of sensor {d.sensor} of {d.array}, {d.first:.3g} to {d.last:.3g} (p = {d.p_value:.2g})"
            for d in self.trends[:3]
        ]
        lines += [f"failed: {log}: {error}" for log, error in self.failures[:5]]
        if len(self.failures) > 5:
            lines.append(f"... and {len(self.failures) - 5} more that failed")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON; of the ranked rows log, axis, sensor and value alone."""
        return {
            "task": self.task,
            "n_logs": self.n_logs,
            "failures": [{"log": log, "error": error} for log, error in self.failures],
            "ranked": [
                {
                    "log": row["log"],
                    "axis": row["axis"],
                    "sensor": row.get("sensor"),
                    "value": value if np.isfinite(value) else None,
                }
                for value, row in self.ranked
            ],
            "noisy": [sensor._asdict() for sensor in self.noisy],
            "outliers": [outlier._asdict() for outlier in self.outliers],
            "doubts": [warning._asdict() for warning in self.weight_warnings],
            "drifts": [trend._asdict() for trend in self.trends],
            "mechanisms": dict(self.mechanisms),
        }


def summarise(task: str, rows: Sequence[Mapping[str, Any]]) -> FleetSummary:
    """Summarise the rows of a fleet's table.

    Logs of sensors with the same names, and of one axis, count as recordings of one array, or of arrays of one kind,
    in the order of the table.

    Args:
        task: `"fuse"`, `"fit"` or `"diagnose"`.
        rows: Rows of the table.
    """
    failures = {identity_in(row): (row["log"], row["error"]) for row in rows if row["status"] != "ok"}
    good = [row for row in rows if row["status"] == "ok"]
    fused = good if task == "fuse" else []
    mechanisms: dict[str, set[str]] = {}
    for row in good if task == "diagnose" else ():
        for name in [*row["mechanisms"], *(["unexplained"] if row["unexplained"] else [])]:
            mechanisms.setdefault(name, set()).add(identity_in(row))
    return FleetSummary(
        task=task,
        n_logs=len(set(map(identity_in, rows))),
        failures=tuple(failures.values()),
        ranked=_ranked(task, good),
        noisy=tuple(sorted(_noisy(fused), key=lambda s: -s.relative_noise)),
        outliers=tuple(sorted(_outliers(fused), key=lambda o: -o.deviations)),
        weight_warnings=tuple(_weight_warnings(fused)),
        trends=tuple(sorted(_trends(fused), key=lambda trend: trend.p_value)),
        mechanisms=tuple(sorted(((name, len(logs)) for name, logs in mechanisms.items()), key=lambda e: -e[1])),
    )


def mean_gain(row: Mapping[str, Any]) -> float:
    """Gain of a row of fusion: geometric mean over averaging times, weighted by the scale weights."""
    gain = np.array(row["gain"], dtype=float)
    counts = np.array(row.get("scale_weights") or np.ones_like(gain), dtype=float)
    known = np.isfinite(gain) & (gain > 0) & (counts > 0)
    return float(np.exp(np.average(np.log(gain[known]), weights=counts[known]))) if known.any() else np.nan


def _ranked(task: str, rows: Sequence[Mapping[str, Any]]) -> tuple[tuple[float, Mapping[str, Any]], ...]:
    """Rows by falling gain or rising p value; those without come last."""
    if task == "fuse":
        valued, sign = [(mean_gain(row), row) for row in rows], -1
    else:
        valued, sign = [(float("nan") if row["p_value"] is None else row["p_value"], row) for row in rows], 1
    return tuple(sorted(valued, key=lambda entry: (np.isnan(entry[0]), sign * entry[0])))


def arrays_of(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Rows grouped by sensors and axis, each group under a name."""
    arrays: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        arrays.setdefault((tuple(row["sensors"]), row["axis"]), []).append(row)
    return {_named(sensors, axis): own for (sensors, axis), own in arrays.items()}


def _named(sensors: Sequence[str], axis: str | None) -> str:
    """Name of an array, of its sensors and axis."""
    first = ", ".join(sensors[:3])
    name = f"array of {len(sensors)} ({first}, ...)" if len(sensors) > 3 else f"array of {first}"
    return f"{name}, axis {axis}" if axis else name


def _noisy(rows: Iterable[Mapping[str, Any]]) -> Iterable[NoisySensor]:
    for array, own in arrays_of(rows).items():
        noise = np.array([row["relative_noise"] for row in own], dtype=float)
        for i, sensor in enumerate(own[0]["sensors"]):
            known = noise[np.isfinite(noise[:, i]), i]
            if known.size:
                yield NoisySensor(array, sensor, float(np.median(known)), len(known))


def _outliers(rows: Sequence[Mapping[str, Any]]) -> Iterable[Outlier]:
    for own in arrays_of(rows).values():
        if len(own) < _FEWEST:
            continue
        shortest = min(len(row["virtual_deviation"]) for row in own)
        quantities = {
            "gain over equal weights": [mean_gain(row) for row in own],
            "Allan deviation of the virtual gyro": [
                float(np.exp(np.log(np.maximum(row["virtual_deviation"][:shortest], 1e-300)).mean())) for row in own
            ],
        }
        for what, values in quantities.items():
            log = np.log(np.array(values, dtype=float))
            middle = np.nanmedian(log)
            sd = stats.median_abs_deviation(log, scale="normal", nan_policy="omit")
            for row, value in zip(own, log, strict=True):
                away = abs(value - middle) / max(sd, 1e-12)
                if away > _OUTLIER and abs(value - middle) > 1e-6:
                    yield Outlier(
                        row["log"], row["axis"], what, float(np.exp(value)), float(np.exp(middle)), float(away)
                    )


def _weight_warnings(rows: Iterable[Mapping[str, Any]]) -> Iterable[WeightWarning]:
    for row in rows:
        short = row["warnings"] if row.get("enough") is False else []
        for why in [*([row["motion"]] if row.get("motion") else []), *short]:
            yield WeightWarning(row["log"], row["axis"], why)


def _place(found: Outlier | WeightWarning) -> str:
    return f"{found.log} axis {found.axis}" if found.axis else found.log


def _trends(rows: Sequence[Mapping[str, Any]]) -> list[WeightTrend]:
    found, n_tests = [], 0
    for array, own in arrays_of(rows).items():
        weights = np.array([row["weights"] for row in own], dtype=float)
        if len(own) < FEWEST_IN_TIME or not np.isfinite(weights).all():
            continue
        n_tests += weights.shape[1]
        third = max(len(own) // 3, 1)
        for i, sensor in enumerate(own[0]["sensors"]):
            tau, p_value = stats.kendalltau(np.arange(len(own)), weights[:, i])
            first, last = np.median(weights[:third, i]), np.median(weights[-third:, i])
            found.append(WeightTrend(array, sensor, float(first), float(last), float(tau), float(p_value)))
    return [t._replace(p_value=min(t.p_value * n_tests, 1.0)) for t in found if t.p_value * n_tests < LEVEL]


__getattr__ = moved_names(
    __name__,
    {
        "Doubt": f"{__name__}.WeightWarning",
        "Drift": f"{__name__}.WeightTrend",
        "Standing": f"{__name__}.FleetSummary",
        "standing_of": f"{__name__}.summarise",
    },
)
