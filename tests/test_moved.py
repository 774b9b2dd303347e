"""Old public paths: each still imports, or fails with a message that names the path of today."""

import importlib
import re
import sys
from pathlib import Path

import pytest

import coudalfish
import shnapr
import tigar_x
import varmint
from tigar_x import moved

OLD = {line.split()[0]: line.split()[1:] for line in (Path(__file__).parent / "old_names.txt").read_text().splitlines()}
"""Public names of the release before this one by their modules: what was defined or listed in each."""


def said(statement):
    """What an import says; None: it succeeds."""
    try:
        exec(statement, {})
    except ImportError as error:
        return str(error)
    return None


def told(message, path):
    """Whether a message names the path of today of an old one, and whether that is really there."""
    new = moved.home(path)
    if new is None:
        old, _, gone = path.rpartition(".")
        return gone in moved.WITHDRAWN.get(old, "").split() and gone in message.split("no longer public: ")[1]
    if path in OLD:
        importlib.import_module(new)
        return bool(re.search(rf"\bis now {re.escape(new)}(?![.\w])", message))
    module, _, name = new.rpartition(".")
    there = re.search(rf"\b(is now|in) {re.escape(module)}(\.{name})?(?![.\w])", message)
    return bool(there) and name in message + path and hasattr(importlib.import_module(module), name)


def test_the_list_of_old_names_is_whole():
    assert len(OLD) == 115
    assert sum(map(len, OLD.values())) == 677


@pytest.mark.parametrize("package", ["tigar_x", "varmint", "shnapr", "coudalfish"])
def test_every_old_path_imports_or_names_its_new_one(package):
    lost = []
    for module, names in OLD.items():
        if module.split(".")[0] != package:
            continue
        message = said(f"import {module}")
        if message and not told(message, module):
            lost.append(f"{module}: {message}")
        for name in names:
            message = said(f"from {module} import {name}")
            if message and not told(message, f"{module}.{name}"):
                lost.append(f"{module}.{name}: {message}")
    assert not lost, "say in tigar_x/moved.py where these are:\n" + "\n".join(lost)


def test_every_path_in_the_tables_is_an_old_one_and_its_new_one_is_there():
    for old, new in moved.MODULES.items():
        assert old in OLD
        importlib.import_module(new)
    for old, new in moved.NAMES.items():
        module, name = old.rsplit(".", 1)
        assert name in OLD[module]
        there, called = new.rsplit(".", 1)
        assert hasattr(importlib.import_module(there), called), new


@pytest.mark.parametrize(
    "statement",
    [
        "import tigar_x.linear",
        "from tigar_x import linear",
        "from tigar_x.linear import direct",
        "import importlib; importlib.import_module('tigar_x.linear')",
    ],
)
def test_every_way_to_import_a_module_that_moved_says_where_it_is(statement):
    assert "tigar_x.linear is now tigar_x.fem.linear" in said(statement)


def test_an_attribute_of_a_package_says_where_a_module_is():
    with pytest.raises(AttributeError, match=r"tigar_x\.linear is now tigar_x\.fem\.linear$"):
        tigar_x.linear  # noqa: B018
    with pytest.raises(AttributeError, match=r"varmint\.pictures is now tigar_x\.run\."):
        varmint.pictures  # noqa: B018
    assert not hasattr(coudalfish, "trace")
    assert not hasattr(shnapr, "neighbours")


def test_a_module_whose_names_went_several_ways_tells_each():
    message = said("from tigar_x.time_integration import generalized_alpha")
    assert "is now tigar_x.fem.time_integration;" in message
    assert re.search(r"generalized_alpha in tigar_x\.fem\.schemes", message)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("varmint.mesh.tagged", "varmint.mesh.named.tagged"),
        ("shnapr.contact.SKIN", "shnapr.contact.self_contact.SKIN"),
        ("coudalfish.step.Step", "coudalfish.step.attempt.Step"),
    ],
)
def test_a_module_that_became_a_package_says_where_its_other_names_are(old, new):
    module, name = old.rsplit(".", 1)
    assert f"{old} is now {new}" in said(f"from {module} import {name}")
    with pytest.raises(AttributeError, match=f"is now {re.escape(new)}"):
        getattr(importlib.import_module(module), name)


def test_a_module_that_lost_a_name_says_where_it_is():
    assert said("from varmint.conditions import given") == "varmint.conditions.given is now tigar_x.compat.given"
    with pytest.raises(AttributeError, match=r"module 'varmint\.conditions' has no attribute 'unheard_of'"):
        importlib.import_module("varmint.conditions").unheard_of  # noqa: B018


def test_what_never_was_is_not_guided():
    assert said("from tigar_x import unheard_of").startswith("cannot import name 'unheard_of' from 'tigar_x'")
    assert said("import tigar_x.fem.unheard_of") == "No module named 'tigar_x.fem.unheard_of'"
    assert said("from varmint.mesh import unheard_of").startswith("cannot import name 'unheard_of' from 'varmint.mesh'")
    with pytest.raises(AttributeError, match=r"module 'varmint\.flow' has no attribute 'unheard_of'"):
        importlib.import_module("varmint.flow").unheard_of  # noqa: B018


def test_the_guide_is_asked_once_and_last():
    moved.install()
    assert [type(finder) for finder in sys.meta_path].count(moved.Guide) == 1
