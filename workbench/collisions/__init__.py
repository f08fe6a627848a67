"""The first paper: Santesteban et al. 2021, one file a stage, in the order of the paper."""
