"""Names of the release before work, with one line of deprecation."""

import subprocess
import sys
from importlib import import_module
from types import SimpleNamespace

import pytest

from dem_jax import deprecation

pytestmark = pytest.mark.filterwarnings("ignore::dem_jax.deprecation.FormerNameWarning")


@pytest.mark.parametrize(
    ("module", "former", "name"),
    [
        (module, *names)
        for module, (_, table) in deprecation.MOVED.items()
        for names in table.items()
    ]
    + [
        ("dem_jax.contact.law", "Response", "Response"),
        ("dem_jax.contact.law", "ContactLaw", "ContactLaw"),
    ],
)
def test_a_name_of_a_module_that_moved_is_the_one_of_now(module, former, name):
    now = import_module(deprecation.MOVED[module][0])
    assert getattr(import_module(module), former) is getattr(now, name)


def test_an_import_of_a_former_module_says_where_it_is_now():
    code = "from dem_jax.contact.law import Response, dashpot; print(Response.__module__, dashpot.damped.__name__)"
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["dem_jax.contact_laws", "damped_force"]
    assert "dem_jax.contact.law is now dem_jax.contact_laws" in done.stderr
    assert import_module("dem_jax").__name__ == "dem_jax"


def test_what_never_was_is_no_module():
    with pytest.raises(ModuleNotFoundError, match="dem_jax.nothing"):
        import_module("dem_jax.nothing")
    with pytest.raises(AttributeError, match="nothing"):
        import_module("dem_jax.contact.law").nothing  # noqa: B018


def test_a_law_of_ones_own_may_have_the_former_methods():
    class Former(SimpleNamespace):
        def pair(self, couple):
            return ("pair", couple)

        def start(self, pair, like):
            return ("start", like)

        def reach(self, pair):
            return None

    with pytest.warns(DeprecationWarning, match="Former.pair is now pair_parameters"):
        deprecation.accept_former_methods(Former())
    law = Former()
    assert law.pair_parameters(1) == ("pair", 1) and law.init_history(1, 2) == ("start", 2)
    assert law.interaction_range(1) is None
