"""Source of truth: the order of use by hand."""

from dataclasses import dataclass

from hyperplanes.utilities.tensors.lru_cache import LRUCache


@dataclass
class Sized:
    nbytes: int


def test_the_least_recently_used_value_is_evicted_first():
    cache = LRUCache(30)
    for name in "abc":
        cache.add(name, Sized(10))
    assert cache.get("a") is not None
    cache.add("d", Sized(10))
    assert [name for name in "abcd" if cache.get(name)] == ["a", "c", "d"]
    assert cache.nbytes == 30


def test_a_replaced_value_counts_once():
    cache = LRUCache(30)
    cache.add("a", Sized(10))
    cache.add("a", Sized(20))
    assert (cache.get("a"), cache.nbytes) == (Sized(20), 20)


def test_a_value_above_the_budget_stays_only_with_keep_last():
    for keep_last in (False, True):
        cache = LRUCache(30, keep_last=keep_last)
        cache.add("a", Sized(10))
        cache.add("large", Sized(40))
        expected = (None, Sized(40), 40) if keep_last else (Sized(10), None, 10)
        assert (cache.get("a"), cache.get("large"), cache.nbytes) == expected
    cache = LRUCache(30)
    cache.add("a", Sized(10))
    cache.add("a", Sized(40))
    assert (cache.get("a"), cache.nbytes) == (None, 0)  # what was replaced is not returned either
