"""Hardware that is not there: chips, boards, foam and what presses on it."""
