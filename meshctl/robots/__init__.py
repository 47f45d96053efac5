"""Deploy, inspect and remove udp_mesh on the robots' computers, over SSH and systemd.

`probe` (facts of the computer) -> `unmet_preconditions` -> inventory + wheels -> `bundle` (content-addressed release)
-> upload -> install beside the running release -> switch by one rename -> health check -> kept, or rolled back. All
code that runs on a robot is in `scripts/`.
"""
