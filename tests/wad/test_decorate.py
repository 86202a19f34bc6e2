"""Names of actor classes in DECORATE text."""

import time

import pytest

from gvz.wad.decorate import declared_actors, declared_numbers, used_sprites

TEXT = """
// ACTOR Commented : Health
/* ACTOR Hidden
   { } */
#include "ACTOR.txt"
ACTOR Poison : Health { Tag "/* no comment" }
aCtOr   Vz~Player.2 : DoomPlayer replaces DoomPlayer 10234
{
  Obituary "ACTOR Text"
}
ACTOR/**/Joined{}
const int ACTOR = 3;
"""


def test_actors_are_listed_in_order_without_comments_and_strings():
    assert declared_actors(TEXT) == ["Poison", "Vz~Player.2", "Joined"]


def test_editor_numbers_and_sprites_are_read_from_classes():
    assert declared_numbers(TEXT) == {10234}
    states = """ACTOR Poison : Health 20001
    {
      Mass 100 // BON9 A 1
      States
      {
      Spawn:
        BON1 ABC 6 Bright
        tnt1 A 0
        SKUL A -1
        Goto Super::Spawn
      }
    }"""
    assert declared_numbers(states) == {20001}
    assert used_sprites(states) == {"BON1A", "BON1B", "BON1C", "SKULA"}


def test_text_without_actors_declares_none():
    assert declared_actors("") == []
    assert declared_actors("actor") == []


@pytest.mark.parametrize("piece", ["/*", '\\"', "\n", "\n ", "actor\n", '"\n', "actor /*"])
def test_text_that_begins_much_and_ends_nothing_is_read_in_linear_time(piece: str):
    start_s = time.thread_time()
    text = "actor A\n" + piece * 100_000
    assert declared_actors(text)[0] == "A"
    assert (declared_numbers(text), used_sprites(text)) == (frozenset(), frozenset())
    assert time.thread_time() - start_s < 2  # with searches for each end to the end of the text: minutes


def test_what_is_not_ended_goes_on_to_the_end():
    assert declared_actors("actor A\n/* actor\nactor B") == ["A"]
    assert declared_actors('actor A\n"actor\nactor B') == ["A", "B"]
