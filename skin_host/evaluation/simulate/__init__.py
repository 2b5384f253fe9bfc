"""The whole system under one seed: `skin simulate`.

The real daemon, the emulated robot, buses, a broker and a disk in memory live by one stepped
clock in one event loop: no thread, socket or sleep takes part, and hours pass in minutes. The
seed decides everything that happens and goes wrong, so a failure can be repeated. While it runs,
promises are checked against the emulator's own truth.

- `world`: robot, buses (`cables`), `broker`, `disk`, the daemon's lives, what presses the skin
- `troubles`: what goes wrong, and what health may and must report of it
- `promises`: what must hold all the while
- `deeds`: what is done to them, each deed noted for the promises
- `storm`, `calm`, `exercises`: when which deeds are done
- `run`: one run of these, and many side by side
"""
