"""Many hostile and broken inputs, each judged: `python -m tests.campaign --cases N`.

A *kind* makes cases of one sort from random numbers: damaged pictures, records with a
wrong value, archives that promise too much. A kind is a module of its own in `kinds`
that holds a `KIND`; nothing else need know of it. A *case* puts files into an empty
folder and does something with them. The *judge* does it in a process of its own and
says what was wrong, if anything was:

- it is taken, or refused by one clear line; there is no traceback, no crash;
- its time and its memory stay below the kind's limits, and nothing ends for lack of
  memory: a limit of ours must come first;
- inputs stay as they are, a refusal leaves nothing behind, and nothing is written
  outside the folder.

What a case knows besides, such as the pixels that must come out, it checks itself.
"""
