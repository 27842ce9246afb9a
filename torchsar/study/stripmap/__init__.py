"""System 004: continuous stripmap, from damaged raw data to a focused image (Tsvetkov 2017)."""
