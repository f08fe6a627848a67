"""Paper 2: Ma, Yang, Tang, Black, "The Power of Points for Modeling Humans in Clothing", ICCV 2021 (POP)."""
