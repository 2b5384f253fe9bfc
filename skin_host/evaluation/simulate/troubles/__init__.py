"""What goes wrong, by name: each begins, lasts a while and ends.

A trouble has the codes that health may report for it, and the one that it must report if it lasts.
"""
