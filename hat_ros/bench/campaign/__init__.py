"""Random clips over everything that decides whether a spacecraft is found, and what came of them."""
