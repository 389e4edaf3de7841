"""Many surveys, and many networks: how they ended."""

from __future__ import annotations

from sfm.remarks.kind import Kind

ROWS = (
    Kind(
        "surveys_failed",
        "error",
        "{surveys:survey} failed: {surveys}.",
        "see the reason in the row of each",
        "Correct the survey files, and run the batch again with --resume.",
    ),
    Kind(
        "surveys_set_aside",
        "error",
        "{surveys:survey} {surveys:was|were} set aside: {surveys}.",
        "the process that computed it died, as where memory is not enough",
        "Run these surveys alone.",
    ),
    Kind(
        "surveys_not_dependable",
        "error",
        "{surveys:survey} {surveys:has|have} no dependable result: {surveys}.",
        "see the remarks in the report of each",
        "Correct what its report names.",
    ),
    Kind(
        "surveys_with_warnings",
        "warning",
        "{surveys:survey} worked with warnings: {surveys}.",
        "see the remarks in the report of each",
        "Read its report before using the result.",
    ),
    Kind(
        "adjuster_differs_in_surveys",
        "warning",
        "COLMAP's adjustment differs in {surveys:survey}: {surveys}.",
        "one of the two adjusters has not reached the minimum",
        "Read the comparison in the report of each.",
    ),
    Kind(
        "adjuster_worse_in_networks",
        "error",
        "In {worse:network} of {networks} Kolinear does not converge or ends at a higher minimum than "
        "{program}.",
        "a fault of the adjuster, or networks with several minima",
        "Look at these networks in the table.",
    ),
    Kind(
        "optima_differ_in_networks",
        "warning",
        "In {differing:network} of {networks} the adjusters do not end at the same optimum.",
        "networks with several minima, or an adjuster that stops early or fails",
        "Look at these networks in the table.",
    ),
)
