"""Draw the results of queries in a notebook: HTML and SVG without scripts, styles of their own or requests.

Text takes the colour of the notebook, signs and bars have colours that contrast with light and dark pages, and every
status has a sign. Everything recorded is escaped and isolated from the direction of the text around it.
"""
