"""Robot controllers that speak the true wire protocols, in a process of their own: `spherecal simulate-controller`.

They move a simulated robot, so that the real adapters (and programs of others) can be tried without hardware, and they
misbehave on order. Only the CLI and tests start them; acquire and calibrate know them only by their network address.
"""
