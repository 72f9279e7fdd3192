"""Small files named after a digest of their content, which shows damage by a power loss or a bad disk."""

from __future__ import annotations

import hashlib
import secrets
from pathlib import Path

from gyrofuse._base.files import sync_file, sync_folder

_DIGITS = 32  # hexadecimal digits of a SHA-256 in a name: 128 bits, so that two contents never share one by chance
DRAFTS = "*.draft"  # pattern of unfinished files


def write_sealed(folder: Path, suffix: str, content: bytes | memoryview) -> Path:
    """Write a file whole or not at all, also at a power loss; the same content gives the same file."""
    path = folder / f"{hashlib.sha256(content).hexdigest()[:_DIGITS]}{suffix}"
    draft = draft_in(folder)
    try:
        draft.write_bytes(content)
        sync_file(draft)
        draft.replace(path)
        sync_folder(folder)
    finally:
        draft.unlink(missing_ok=True)
    return path


def read_sealed(path: Path) -> bytes | None:
    """Content of a file; None if it is not what was written, or cannot be read."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    return content if hashlib.sha256(content).hexdigest()[:_DIGITS] == path.stem else None


def draft_in(folder: Path) -> Path:
    """A new name for an unfinished file."""
    return folder / f"{secrets.token_hex(8)}{DRAFTS[1:]}"
