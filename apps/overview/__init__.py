"""Many runs, predictions and trials in one page: what each speed costs in image error.

Rule: no speed stands without its error, or the word that there is none.
"""
