"""Result folders, arrays, pictures and reports of experiments."""
