"""Completion of the command line in shells: commands, options, their values, names of configs."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_BASH = """# completion of torchsar for bash
_torchsar_words() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" command="" words="" i
    local configs="{configs}"
    for ((i = 1; i < COMP_CWORD; i++)); do
        case "${{COMP_WORDS[i]}}" in {commands}) command="${{COMP_WORDS[i]}}"; break ;; esac
    done
    case "$command $before" in
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _torchsar_words torchsar
"""
# zsh understands the script for bash, whether it is sourced or loaded at the first completion, as
# the body of the function _torchsar, which then has to complete by itself
_ZSH = """#compdef torchsar
(( $+functions[compdef] )) || {{ autoload -U +X compinit && compinit; }}
autoload -U +X bashcompinit && bashcompinit
{bash}
[[ $funcstack[1] != _torchsar ]] || _bash_complete -o default -F _torchsar_words
"""


@dataclass(frozen=True)
class _Command:
    """What may follow the name of a command.

    Args:
        name: The name; empty for the program itself.
        about: Its help.
        options: All options.
        values: Values of options that have some.
        words: Other words; "$configs" for the names of packaged configs.
    """

    name: str
    about: str
    options: list[str]
    values: dict[str, list[str]]
    words: list[str]


def completion(shell: str, parser: argparse.ArgumentParser, configs: Iterable[str]) -> str:
    """Return a script that completes the commands of a parser; files are completed elsewhere.

    Args:
        shell: "bash", "zsh" or "fish".
        parser: Parser with commands.
        configs: Names that may be given for an argument called `config`.

    Returns:
        The script.
    """
    action = next(one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    about = {one.dest: one.help or "" for one in action._choices_actions}
    commands = [_command(name, about[name], one) for name, one in action.choices.items()]
    whole, known = _command("", "", parser), " ".join(sorted(configs))
    if shell == "fish":
        return _fish(whole, commands, known)
    script = _bash(whole, commands, known)
    return _ZSH.format(bash=script) if shell == "zsh" else script


def _command(name: str, about: str, parser: argparse.ArgumentParser) -> _Command:
    found = _Command(name, about, [], {}, [])
    for action in parser._actions:
        choices = [] if isinstance(action, argparse._SubParsersAction) else [str(one) for one in action.choices or ()]
        options = [option for option in action.option_strings if option.startswith("--")]
        found.options.extend(options)
        if not options:
            found.words.extend(choices or (["$configs"] if action.dest == "config" else []))
        elif action.nargs != 0:
            found.values.update(dict.fromkeys(options, choices))
    return found


def _bash(whole: _Command, commands: Sequence[_Command], configs: str) -> str:
    cases = []
    for one in (whole, *commands):
        words = [*one.options, *one.words, *(each.name for each in commands if one is whole)]
        cases += [f'        "{one.name} {option}") words="{" ".join(x)}" ;;' for option, x in one.values.items()]
        cases.append(f'        "{one.name} "*) words="{" ".join(words)}" ;;')
    names = "|".join(one.name for one in commands)
    return _BASH.format(commands=names, configs=configs, cases="\n".join(cases))


def _fish(whole: _Command, commands: Sequence[_Command], configs: str) -> str:
    lines = ["# completion of torchsar for fish", f"set -l configs {configs}"]
    before = f"not __fish_seen_subcommand_from {' '.join(one.name for one in commands)}"
    for one in (whole, *commands):
        condition = f"__fish_seen_subcommand_from {one.name}" if one.name else before
        for option in one.options:
            values = f" -r -a '{' '.join(one.values[option])}'" if option in one.values else ""
            lines.append(f"complete -c torchsar -n '{condition}' -l {option[2:]}{values}")
        if one.words:
            lines.append(f"complete -c torchsar -n '{condition}' -a \"{' '.join(one.words)}\"")
    for one in commands:
        about = one.about.replace("\\", "\\\\").replace("'", "\\'")
        lines.append(f"complete -c torchsar -n '{before}' -a {one.name} -d '{about}'")
    return "\n".join(lines) + "\n"
