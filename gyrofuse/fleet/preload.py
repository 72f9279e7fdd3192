"""Modules that the processes of a fleet need, imported in the process that they are forked from.

Imported modules are never freed: garbage collection is off during the imports, and their objects are then frozen, so
that no collection touches, and thereby copies, the memory pages that the forks share.
"""

import gc

collecting = gc.isenabled()
gc.disable()
try:
    import gyrofuse.fleet.processes  # noqa: F401
finally:
    gc.freeze()
    if collecting:
        gc.enable()
