"""One answer against one truth."""

from __future__ import annotations

import math
from typing import Any

from scipy.stats import norm

Record = dict[str, Any]
ABSTAINED = "not_identifiable"
SILENT = 2.0  # per degree of freedom, where chance gives one: what nobody would call explained
RESOLVED = 8.0  # nats from which a sensor must be named


def findings(answer: Record | None) -> list[Record]:
    """Findings of an answer; none where the diagnosis failed."""
    return list((answer or {}).get("findings") or [])


def detected(answer: Record | None) -> bool:
    """Whether the answer claims a mismatch."""
    return bool((answer or {}).get("mismatch"))


def silent(answer: Record | None) -> bool:
    """Whether a plain discrepancy is left on the blocks held out, and nothing is said to be unexplained."""
    left = ((answer or {}).get("held_out") or {}).get("after")
    return left is not None and left > SILENT and not (answer or {}).get("unexplained")


def in_class(finding: Record, classes: set[str]) -> bool:
    """The name, or an alternative stated with it, is one that the data allow."""
    return finding["mechanism"] in classes or bool(classes.intersection(finding.get("alternatives") or []))


def match(effect: Record, answer: Record | None) -> Record | None:
    """The finding that answers an effect: by its name first, then by its class."""
    candidates = findings(answer)
    for finding in candidates:
        if finding["mechanism"] == effect["mechanism"]:
            return finding
    return next((finding for finding in candidates if in_class(finding, set(effect["class"]))), None)


def wrong_names(truth: Record, answer: Record | None) -> list[Record]:
    """Findings that name a mechanism with confidence, and neither it nor an alternative is true of any effect."""
    classes = {name for effect in truth["effects"] for name in effect["class"]}
    return [f for f in findings(answer) if f["mechanism"] != ABSTAINED and not in_class(f, classes)]


def oracle_detects(effect: Record, false_alarm: float) -> bool:
    """The likelihood-ratio test of the known effect with known parameters.

    Its threshold comes from the mean, variance and skewness that the ratio has under the base (Cornish-Fisher); where
    they do not tell its upper tail, it is log(1/false_alarm), which holds for any law (Markov); where one altered
    sample is proof, it is zero.
    """
    mean, variance, third = effect["oracle_null"]
    z = float(norm.isf(false_alarm))
    quantile = z + (z**2 - 1) * third / variance**1.5 / 6
    threshold = {
        "cumulants": mean + quantile * math.sqrt(variance),
        "bound": -math.log(false_alarm),
        "certain": 0.0,
    }[effect["oracle_law"]]
    return bool(effect["oracle_llr"] > threshold)


def right_sensors(effect: Record, finding: Record) -> tuple[bool, bool]:
    """The exact set; and no wrong sensor with every one that has `RESOLVED` nats."""
    named, true = set(finding.get("sensors") or []), set(effect["sensors"])
    nats = effect["sensor_nats"] or [math.inf] * len(effect["sensors"])
    strong = {sensor for sensor, n in zip(effect["sensors"], nats, strict=True) if n >= RESOLVED}
    return named == true, strong <= named <= true


def oracle_exact(effect: Record) -> float | None:
    """The chance that likelihood ratios which know the effect's size leave out none of its sensors.

    The ratio of a sensor that holds n nats is close to Gaussian, of mean n and variance 2 n; below zero the sensor is
    left out.
    """
    if not effect["sensor_nats"]:
        return None
    return math.prod(float(norm.cdf(math.sqrt(max(nats, 0.0) / 2))) for nats in effect["sensor_nats"])


def frequency_error(effect: Record, finding: Record) -> float | None:
    """In Cramer-Rao standard deviations."""
    if effect["frequency_sd_hz"] is None or finding.get("frequency_hz") is None:
        return None
    return float(abs(finding["frequency_hz"] - effect["frequency_hz"]) / effect["frequency_sd_hz"])


def onset_error(effect: Record, finding: Record) -> float | None:
    """In the oracle's standard deviations; the first time where a finding has several."""
    said = finding.get("time_s")
    if isinstance(said, (list, tuple)):
        said = said[0] if said else None
    if effect["onset_sd_s"] is None or said is None:
        return None
    return float(abs(said - effect["time_s"]) / effect["onset_sd_s"])


def _true_value(effect: Record, name: str, unit: str) -> float | None:
    """Of a stated parameter; `name[i]` is that of sensor i, a bare name the array's (root mean square).

    None where the truth has no such name, sensor or unit.
    """
    bare, _, index = name.removesuffix("]").partition("[")
    true = effect["parameters"].get(bare)
    if true is None or true["unit"] != ("" if unit == "1" else unit):
        return None
    if not index:
        return float(true["value"])
    if int(index) not in effect["sensors"]:
        return None
    return float(true.get("per_sensor", [true["value"]] * len(effect["sensors"]))[effect["sensors"].index(int(index))])


def coverage(effect: Record, finding: Record) -> list[tuple[str, bool]]:
    """(name without its sensor, covered) of each stated interval that can be judged; one for several sensors once."""
    judged: dict[tuple[str, float, float, float], bool] = {}
    for name, said in (finding.get("parameters") or {}).items():
        true = _true_value(effect, name, said.get("unit") or "")
        if true is not None and said.get("low") is not None and said.get("high") is not None:
            interval = (name.partition("[")[0], said["low"], said["high"], true)
            judged[interval] = bool(said["low"] <= true <= said["high"])
    return [(interval[0], covered) for interval, covered in judged.items()]


def unmatched(effect: Record, finding: Record) -> list[str]:
    """Stated parameters that cannot be judged: the truth has not that name, sensor or unit."""
    said = finding.get("parameters") or {}
    return [name for name in said if _true_value(effect, name, said[name].get("unit") or "") is None]
