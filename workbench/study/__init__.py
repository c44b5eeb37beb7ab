"""Studies: experiments of the papers run again, and what each technique saved."""
