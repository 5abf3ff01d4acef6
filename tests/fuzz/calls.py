def run_calls(cases, seed, home):
    return []
