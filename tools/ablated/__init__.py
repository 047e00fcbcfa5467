"""What `tools/ablation.py` switches off, and the frames on which it does."""
