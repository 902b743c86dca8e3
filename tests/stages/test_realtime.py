"""Garbage of a supervisor is collected, and never at a moment that the loop has not chosen."""

import gc
import weakref

import pytest

from fitctl.stages.realtime import GarbageCollector, quiet_interpreter


class Node:
    """Half of a cycle."""

    def __init__(self, other=None):
        self.other = other or Node(self)


@pytest.fixture
def collector():
    """As a supervisor has it after its start; the interpreter of the tests is given back as it was."""
    quiet_interpreter()
    yield GarbageCollector()
    gc.unfreeze()
    gc.enable()


def a_cycle():
    node = Node()
    return node, weakref.ref(node)


@pytest.mark.long
def test_nothing_is_collected_between_two_calls(collector):
    node, alive = a_cycle()
    del node
    kept = [[] for _ in range(100_000)]  # Python would have collected a hundred times meanwhile
    assert kept
    assert alive() is not None


@pytest.mark.long
def test_a_cycle_that_dies_young_is_collected_at_the_next_call(collector):
    node, alive = a_cycle()
    del node
    collector.collect(pointing=True)
    assert alive() is None


@pytest.mark.long
def test_a_cycle_that_lived_through_collections_is_collected_once_it_dies(collector):
    node, alive = a_cycle()
    for _ in range(5):
        collector.collect(pointing=True)
    assert alive() is node
    del node
    collector.collect(pointing=True)
    assert alive() is None


@pytest.mark.long
def test_many_new_objects_are_looked_at_once(collector):
    library = [[] for _ in range(10_000)]
    collector.collect(pointing=True)
    assert len(gc.get_objects()) < 1000
    assert len(library) == 10_000


@pytest.mark.long
def test_what_was_set_aside_is_collected_when_the_stages_come_to_rest(collector):
    node, alive = a_cycle()
    library = [[] for _ in range(10_000)]
    collector.collect(pointing=True)  # sets both aside
    del node, library
    collector.collect(pointing=True)
    assert alive() is not None  # a collection of everything would hold up the loop
    collector.collect(pointing=False)
    assert alive() is None


@pytest.mark.long
def test_a_rig_at_rest_is_not_held_up_each_second(collector):
    node, alive = a_cycle()
    library = [[] for _ in range(10_000)]
    collector.collect(pointing=False)
    del node, library
    for _ in range(5):
        collector.collect(pointing=False)
    assert alive() is not None
    collector.collect(pointing=True)
    collector.collect(pointing=False)
    assert alive() is None
