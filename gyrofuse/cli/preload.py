"""What the processes of a fleet need, imported in one go in the process that they are forked from.

Nothing of it is ever thrown away: there is nothing to collect meanwhile, and the forks share it as long as nobody looks
it through.
"""

import gc

collecting = gc.isenabled()
gc.disable()
try:
    import gyrofuse.cli.app
    import gyrofuse.fleet.processes  # noqa: F401
finally:
    gc.freeze()
    if collecting:
        gc.enable()
