"""How the cameras stand to each other: given poses checked and refined, unknown ones estimated, captures."""
