"""`python -m turbnet`."""

from turbnet.cli import main

main()
