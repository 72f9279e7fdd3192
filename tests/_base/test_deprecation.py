"""What has moved is found under its old name, with a warning that says where it is."""

from __future__ import annotations

import subprocess
import sys
import types

import pytest

import gyrofuse
from gyrofuse._base.deprecation import RenamedAttribute, moved_names, renamed_arguments

IMPORTED = """import gyrofuse
from gyrofuse.intervals import wavelet_variance_interval as old
import gyrofuse.wavelets.intervals as new
assert old is new.wavelet_variance_interval and new.__spec__.name == "gyrofuse.wavelets.intervals"
import importlib, gyrofuse._base.deprecation
for name in gyrofuse._base.deprecation._MODULES:
    importlib.import_module("gyrofuse." + name)
assert all(callable(getattr(gyrofuse, name)) for name in gyrofuse.__all__)  # not hidden by the modules
"""


def test_every_old_module_is_found_and_hides_no_public_function():
    from gyrofuse._base.deprecation import _MODULES

    command = [sys.executable, "-W", "always", "-c", IMPORTED]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    assert "<string>:2: DeprecationWarning: gyrofuse.intervals is deprecated" in said
    assert "use gyrofuse.wavelets.intervals" in said
    assert said.count("is deprecated and goes with release 0.3") == len(_MODULES)


def test_a_module_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"gyrofuse\.nothing"):
        __import__("gyrofuse.nothing")


def test_names_that_left_a_module():
    module = types.ModuleType("room")
    module.__getattr__ = moved_names("room", {"table": "gyrofuse.fit_svo"})  # type: ignore[method-assign]
    with pytest.warns(DeprecationWarning, match=r"room\.table is deprecated .* use gyrofuse\.fit_svo") as warned:
        assert module.table is gyrofuse.fit_svo
    assert warned[0].filename == __file__
    with pytest.raises(AttributeError, match="module 'room' has no attribute 'chair'"):
        module.chair  # noqa: B018


def test_names_that_left_the_package():
    for name in gyrofuse._MOVED:
        with pytest.warns(DeprecationWarning, match=rf"gyrofuse\.{name} is deprecated .* use gyrofuse\.") as warned:
            assert callable(getattr(gyrofuse, name))
        assert warned[0].filename == __file__
        assert name not in gyrofuse.__all__


def test_arguments_by_their_old_names():
    @renamed_arguments(old="new")
    def double(new: int) -> int:
        return 2 * new

    assert double(2) == double(new=2) == 4
    with pytest.warns(DeprecationWarning, match="`old` is deprecated .* use `new`") as warned:
        assert double(old=2) == 4
    assert warned[0].filename == __file__
    with pytest.raises(TypeError, match="`old` is the old name of `new`: give one"):
        double(new=1, old=2)


def test_attributes_by_their_old_names():
    class Result:
        std = RenamedAttribute("std_err")

        def __init__(self) -> None:
            self.std_err = 3.0

    with pytest.warns(DeprecationWarning, match=r"Result\.std is deprecated .* use std_err") as warned:
        assert Result().std == 3.0
    assert warned[0].filename == __file__
