"""Videos of robots in motion, with captions."""
