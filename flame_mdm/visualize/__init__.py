"""Seeing motion: an HTML player, GIF and MP4 videos, and still images."""

from flame_mdm.visualize.player import player_page, write_player
from flame_mdm.visualize.render import contact_sheet, frames_array, write_gif, write_mp4
from flame_mdm.visualize.scene import Motion

__all__ = ["Motion", "contact_sheet", "frames_array", "player_page", "write_gif", "write_mp4", "write_player"]
