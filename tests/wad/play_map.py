"""Plays a WAD's MAP01 without doing anything and prints what its scripts wrote into USER variables, as JSON.

A program of its own, because a map the engine does not like ends the process that runs the engine.

usage: play_map.py WAD NUM_TICS
"""

import json
import sys
from pathlib import Path

import vizdoom

NUM_USER_VARIABLES = 60


def main() -> None:
    wad, num_tics = sys.argv[1], int(sys.argv[2])
    game = vizdoom.DoomGame()
    game.set_doom_game_path(str(Path(vizdoom.__file__).parent / "freedoom2.wad"))
    game.set_doom_scenario_path(wad)
    game.set_doom_map("MAP01")
    game.set_doom_skill(3)
    game.set_window_visible(False)
    game.set_screen_resolution(vizdoom.ScreenResolution.RES_160X120)
    game.set_available_buttons([vizdoom.Button.ATTACK])
    game.set_seed(7)
    game.add_game_args("+logfile engine.log")
    game.init()
    for _ in range(num_tics):
        if game.is_episode_finished():
            break
        game.make_action([0.0])
    numbers = range(1, NUM_USER_VARIABLES + 1)
    variables = [game.get_game_variable(getattr(vizdoom.GameVariable, f"USER{i}")) for i in numbers]
    print(json.dumps({"user": variables, "finished": game.is_episode_finished(), "dead": game.is_player_dead()}))
    game.close()


if __name__ == "__main__":
    main()
