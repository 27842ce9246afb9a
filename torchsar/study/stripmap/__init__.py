"""System 004: continuous stripmap, from impaired raw data to a focused image (Tsvetkov 2017)."""
