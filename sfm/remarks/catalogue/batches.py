"""Many surveys, and many networks: how they ended."""

from __future__ import annotations

from sfm.remarks.kind import Kind

ROWS = (
    Kind(
        "surveys_failed",
        "error",
        "{surveys:survey} failed: {surveys}.",
        "see the reason in the row of each",
        "Correct {surveys:the survey file|the survey files}, and run the batch again with --resume.",
    ),
    Kind(
        "surveys_set_aside",
        "error",
        "{surveys:survey} {surveys:was|were} set aside: {surveys}.",
        "the process that computed {surveys:it|them} died, as where memory is not enough",
        "Run {surveys:this survey alone|each of these surveys alone}.",
    ),
    Kind(
        "surveys_not_dependable",
        "error",
        "{surveys:survey} {surveys:has|have} no dependable result: {surveys}.",
        "see the remarks in the report of each",
        "Correct what {surveys:its report names|their reports name}.",
    ),
    Kind(
        "surveys_with_warnings",
        "warning",
        "{surveys:survey} worked with warnings: {surveys}.",
        "see the remarks in the report of each",
        "Read {surveys:its report before using the result|their reports before using the results}.",
    ),
    Kind(
        "adjuster_differs_in_surveys",
        "warning",
        "COLMAP's adjustment differs in {surveys:survey}: {surveys}.",
        "one of the two adjusters has not reached the minimum",
        "Read the comparison in the report of each.",
    ),
    Kind(
        "same_optimum",
        "note",
        "Network {network}: Kolinear and {program} end at the same optimum.",
        "both adjusters are right",
        "Nothing needs to be done.",
        short="same optimum",
    ),
    Kind(
        "kolinear_higher",
        "error",
        "Network {network}: Kolinear ends at a higher cost than {program}, {apart} standard deviations away.",
        "a fault of the adjuster, or a network with several minima",
        "Look at this network in the table.",
        short="Kolinear higher",
    ),
    Kind(
        "kolinear_lower",
        "warning",
        "Network {network}: {program} ends at a higher cost than Kolinear, {apart} standard deviations away.",
        "the other program stops early, or a network with several minima",
        "Look at this network in the table.",
        short="Kolinear lower",
    ),
    Kind(
        "kolinear_failed",
        "error",
        "Network {network}: Kolinear finds no solution, {program} does[[: {message}]].",
        "a fault of the adjuster, or start values too far off",
        "Look at this network in the table.",
        short="Kolinear failed",
    ),
    Kind(
        "other_adjuster_failed",
        "warning",
        "Network {network}: {program} finds no solution, Kolinear does[[: {their_message}]].",
        "the other program stops early, or loses points",
        "Look at this network in the table.",
        short="the other adjuster failed",
    ),
    Kind(
        "both_adjusters_failed",
        "warning",
        "Network {network}: neither Kolinear nor {program} finds a solution: {message}; {their_message}.",
        "start values too far off, or a network that is not determined",
        "Look at this network in the table.",
        short="both failed",
    ),
)
