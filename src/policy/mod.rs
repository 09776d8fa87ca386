//! Pure decisions: no IO, no clock, no threads, no logs; time is an argument.
