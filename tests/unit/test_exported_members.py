"""Every public name that a module promises exists, and the promise is sorted."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import radiosity
import workbench


def _modules() -> list[str]:
    names = ["radiosity", "workbench"]
    for package in (radiosity, workbench):
        names += [found.name for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")]
    return sorted(name for name in names if not name.rpartition(".")[2].startswith("_"))


def _order(public: str) -> tuple[int, str]:
    """Constants, then classes, then functions, each by alphabet, as ruff's RUF022 sorts them."""
    return (0 if public.isupper() else 1 if public[0].isupper() else 2, public)


@pytest.mark.parametrize("name", _modules())
def test_promised_names_exist_and_are_sorted(name):
    module = importlib.import_module(name)
    assert module.__doc__ and len(module.__doc__) > 20, f"{name} needs a docstring that says what it is for"
    promised = getattr(module, "__all__", None)
    if promised is None:
        assert hasattr(module, "__path__"), f"{name} has no __all__"
        return
    assert len(set(promised)) == len(promised)
    assert list(promised) in (sorted(promised), sorted(promised, key=_order)), f"{name}.__all__ is not sorted"
    for public in promised:
        assert getattr(module, public) is not None


def test_lazy_names_refuse_what_is_not_promised():
    with pytest.raises(AttributeError, match="no attribute 'solvent'"):
        radiosity.solvent  # noqa: B018
    assert set(radiosity.__all__) <= set(dir(radiosity))
