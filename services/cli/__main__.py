"""`python -m services.cli` is `orthostream`."""

from services.cli import app

app()
