"""Names of actor classes in DECORATE text."""

from gvz.wad.decorate import declared_actors

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


def test_text_without_actors_declares_none():
    assert declared_actors("") == []
    assert declared_actors("actor") == []
