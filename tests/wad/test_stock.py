"""What is read from the installed engine."""

import importlib.util

import pytest

from gvz.core.errors import WadError
from gvz.wad.stock import engine_directory, scenario_wad, stock_actors, stock_editor_numbers, stock_sprites


def test_dooms_actors_are_known_and_other_games_are_not():
    wanted = """ZombieMan MarineChainsaw DoomImp Cacodemon LostSoul Arachnotron Fatso PainElemental Archvile Revenant
        BaronOfHell Demon Medikit Stimpack Clip ClipBox Pistol Fist RocketLauncher RocketAmmo DoomPlayer HeadsOnAStick
        LiveStick HeadCandles TallGreenColumn TallRedColumn HeartColumn BlueTorch GreenTorch RedTorch MapSpot Health"""
    assert set(wanted.split()) <= stock_actors()
    assert not {"HereticImp", "Mummy", "Ettin", "StrifePlayer", "FlemoidusCommonus", "actor"} & stock_actors()


def test_dooms_editor_numbers_and_sprites_are_known():
    assert {1, 26, 42, 2012, 3001, 9001} <= stock_editor_numbers()
    assert not {5555, 31999} & stock_editor_numbers()
    assert {"BON1D", "MEDIA", "SKULF", "DOGSA", "VILED"} <= stock_sprites(), "VILED is a mirrored picture alone"
    assert not {"BON1E", "MEDI", "S_EN", "MUMMA"} & stock_sprites()


def test_a_scenario_is_read_by_its_file_name():
    assert scenario_wad("basic.wad").startswith(b"PWAD")


@pytest.mark.parametrize("name", ["nosuch.wad", "../freedoom2.wad", "basic.cfg", ""])
def test_a_scenario_that_is_not_there_is_answered_with_those_that_are(name: str):
    with pytest.raises(WadError, match=r"scenario WAD: got .*, want one of basic\.wad, .*take_cover\.wad"):
        scenario_wad(name)


def test_without_the_engine_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    engine_directory.cache_clear()
    with pytest.raises(WadError, match="vizdoom: got no installed package, want one; run `pip install vizdoom`"):
        engine_directory()
    monkeypatch.undo()
    assert engine_directory().is_dir()
