"""Visualization of motions: an HTML player, GIF and MP4 videos, and still images."""

from flame_mdm.visualize.player import player_page, write_player
from flame_mdm.visualize.render import contact_sheet, write_gif, write_mp4

__all__ = ["contact_sheet", "player_page", "write_gif", "write_mp4", "write_player"]
