"""Videos of episodes: MP4 or GIF, from any camera, several side by side."""
