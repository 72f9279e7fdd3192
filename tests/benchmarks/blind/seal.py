"""Sealed truths and frozen answers.

digest = seal(truths, "truth.json")                     published before the analyst begins
frozen = freeze(answers, digest, "answers.json")        published before the judge begins
truths, answers = unseal("truth.json", digest, "answers.json", frozen)
"""

from __future__ import annotations

import hashlib
import json
import math
import secrets
from pathlib import Path
from typing import Any

import numpy as np


class SealBrokenError(ValueError):
    """A file is not the one whose digest was published."""


def plain(value: Any) -> Any:
    """Numbers, strings, lists and dictionaries alone; what is not finite becomes None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def digest_of(content: Any) -> str:
    """SHA-256 of the canonical JSON: sorted keys, no blanks."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def seal(truths: list[dict[str, Any]], path: str | Path) -> str:
    """Write the truths with a random salt, so that no guess can be checked against the digest; return the digest."""
    envelope = {"salt": secrets.token_hex(32), "truths": plain(truths)}
    Path(path).write_text(json.dumps(envelope))
    return digest_of(envelope)


def freeze(answers: list[dict[str, Any] | None], truth_digest: str, path: str | Path) -> str:
    """Write the answers, bound to the truths they answer; None is a diagnosis that failed. Return the digest."""
    envelope = {"truth_digest": truth_digest, "answers": plain(answers)}
    Path(path).write_text(json.dumps(envelope))
    return digest_of(envelope)


def unseal(
    truth_path: str | Path, truth_digest: str, answers_path: str | Path, answers_digest: str
) -> tuple[list[dict[str, Any]], list[dict[str, Any] | None]]:
    """Truths and answers, once the answers are known to be frozen and both files to be the published ones."""
    answers = json.loads(Path(answers_path).read_text())
    if digest_of(answers) != answers_digest:
        raise SealBrokenError(f"`answers_path`: expected the frozen answers {answers_digest[:12]}, got another file")
    if answers["truth_digest"] != truth_digest:
        raise SealBrokenError("`answers_path`: expected answers to these truths, got answers to others")
    truths = json.loads(Path(truth_path).read_text())
    if digest_of(truths) != truth_digest:
        raise SealBrokenError(f"`truth_path`: expected the sealed truths {truth_digest[:12]}, got another file")
    if len(truths["truths"]) != len(answers["answers"]):
        raise SealBrokenError(
            f"`answers_path`: expected {len(truths['truths'])} answers, got {len(answers['answers'])}"
        )
    return truths["truths"], answers["answers"]
