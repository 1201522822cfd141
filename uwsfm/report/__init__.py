"""report.html: what a reconstruction is worth, on one page that needs no network.

Plain numbers are gathered first (`gather`, `residuals`, `view`, `words`); `page` fills
the template with them, `pictures` draws the same as PNG, `files` writes it all.
"""
