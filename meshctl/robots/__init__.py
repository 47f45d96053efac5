"""udp_mesh on the robots' computers: put there, proved, watched, taken away, over SSH and systemd.

inventory + wheels -> `bundle` (what one computer gets, named by its content) -> `probe` (what the computer is and has)
-> `objections` (why it cannot take it) -> upload -> install beside what runs -> switch by one rename -> health -> kept,
or back to the release before. Everything that runs on a robot is a script in `scripts/`.
"""
