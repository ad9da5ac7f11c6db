"""Hard cases: scenes that make a simulator of rods blow up, and what must hold in each."""
