"""Report: what was found, on one page, beside what the paper prints."""
