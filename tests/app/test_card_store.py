"""Cards that are kept from one start of the app to the next."""

import pytest

from dem_jax.app import card_store, facts
from dem_jax.scene import library


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "dem_jax"


def test_cards_are_computed_once_and_anew_for_other_sources(cache, monkeypatch):
    counted = []

    def compute():
        counted.append(None)
        return [{"name": "nugget", "weight": 24.0}]

    first = card_store.recall_cards("cards", compute)
    assert card_store.recall_cards("cards", compute) == first and len(counted) == 1
    monkeypatch.setattr(card_store, "hash_sources", lambda: "another version")
    assert card_store.recall_cards("cards", compute) == first and len(counted) == 2


@pytest.mark.parametrize("content", [b"", b"\xff\x00", b"[]", b'{"sources": 1}', b'"text"'])
def test_a_damaged_file_is_replaced(cache, content):
    cache.mkdir()
    (cache / "cards.json").write_bytes(content)
    assert card_store.recall_cards("cards", lambda: [1]) == [1]
    assert card_store.recall_cards("cards", lambda: [2]) == [1], "it was replaced"


def test_without_a_folder_cards_are_computed(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert card_store.recall_cards("cards", lambda: [1]) == [1]


def test_kept_product_cards_are_those_computed(cache, monkeypatch):
    one = dict(list(library.list_products().items())[:1])
    monkeypatch.setattr(library, "list_products", lambda: one)
    computed = facts.describe_products()
    assert facts.describe_products() == computed and (cache / "product-cards.json").is_file()
    assert isinstance(computed[0].rows[0], tuple)
