"""Cost against error: measured, judged, shown.

- `measurement`: what was found, as plain data
- `timing_rounds`: times of steps without observation
- `measure`: a test system run through methods
- `fronts`: the Pareto front
- `recommendation`: which method and step for a wanted error
- `answer`: which method and step, in one sentence
- `chosen_curves`, `interactive`: curves of diagrams, and diagrams to play with
- `report`: table, plot and file of one comparison
- `parts_of_the_whole`, `whole`, `whole_page`: all test systems at once
"""
