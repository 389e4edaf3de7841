"""python -m sfm.cli, the same as kolinear."""

from sfm.cli import main

main()
