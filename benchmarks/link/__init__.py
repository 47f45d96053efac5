"""One emulated link that every transport crosses: `emulator.c` moves the frames, `laboratory.py` sets the scene."""
