//! A screen as an SVG picture. Lines, bars and Braille dots are drawn as shapes, so that no font of a reader
//! can shift them.

use ratatui::buffer::{Buffer, Cell};
use ratatui::style::{Color, Modifier};
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Width and height of a cell.
const CELL: [f64; 2] = [8.0, 16.0];
const BACKGROUND: &str = "#16181d";
const FOREGROUND: &str = "#d5d8de";

/// A colour as a terminal shows it; `None` for the terminal's own colour.
fn colour(colour: Color) -> Option<&'static str> {
    Some(match colour {
        Color::Reset => return None,
        Color::Black => "#000000",
        Color::DarkGray => "#767c88",
        Color::Red => "#e0565b",
        Color::Green => "#5fb865",
        Color::Yellow => "#dcb848",
        Color::Blue => "#3d6fb8",
        Color::Cyan => "#4fb9c9",
        other => panic!("no colour for {other:?}"),
    })
}

/// Foreground and background of a cell.
fn colours(cell: &Cell) -> [&'static str; 2] {
    let fg = colour(cell.fg).unwrap_or(FOREGROUND);
    let bg = colour(cell.bg).unwrap_or(BACKGROUND);
    if cell.modifier.contains(Modifier::REVERSED) { [bg, fg] } else { [fg, bg] }
}

/// The shapes of one colour, as SVG paths.
#[derive(Default)]
struct Shapes {
    areas: String,
    lines: String,
}

/// Draws the character of a cell whose corner is at `x`, `y`; false if the character is text.
fn draw(c: char, [x, y]: [f64; 2], shapes: &mut Shapes) -> bool {
    let [width, height] = CELL;
    let mut area = |x: f64, y: f64, w: f64, h: f64| {
        let _ = write!(shapes.areas, "M{x} {y}h{w}v{h}h{}z", -w);
    };
    match c {
        // Dots 1 to 3 and 4 to 6 go down the two columns, dots 7 and 8 are below (Unicode, 2800).
        '\u{2800}'..='\u{28ff}' => {
            const DOTS: [[u8; 2]; 8] =
                [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2], [0, 3], [1, 3]];
            let bits = u32::from(c) - 0x2800;
            for (_, dot) in DOTS.iter().enumerate().filter(|(n, _)| bits >> n & 1 == 1) {
                let [column, row] = dot.map(f64::from);
                area(x + 1.0 + 4.0 * column, y + 1.0 + 4.0 * row, 2.0, 2.0);
            }
        }
        // Bars in eighths of a cell.
        '\u{2588}'..='\u{258f}' => {
            area(x, y, f64::from(0x2590 - u32::from(c)) / 8.0 * width, height);
        }
        '─' | '│' | '┌' | '┐' | '└' | '┘' => {
            let [left, right] = ["─┐┘", "─┌└"].map(|with| with.contains(c));
            let [up, down] = ["│└┘", "│┌┐"].map(|with| with.contains(c));
            let (middle, centre) = (x + width / 2.0, y + height / 2.0);
            for (is_drawn, end) in [
                (left, [x, centre]),
                (right, [x + width, centre]),
                (up, [middle, y]),
                (down, [middle, y + height]),
            ] {
                if is_drawn {
                    let _ = write!(shapes.lines, "M{middle} {centre}L{} {}", end[0], end[1]);
                }
            }
        }
        _ => return false,
    }
    true
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// The picture of `screen`.
pub(super) fn svg(screen: &Buffer) -> String {
    let [cell_width, cell_height] = CELL;
    let size = [f64::from(screen.area.width), f64::from(screen.area.height)];
    let [width, height] = [size[0] * cell_width, size[1] * cell_height];
    let mut picture = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
         font-family=\"monospace\" font-size=\"13\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"{BACKGROUND}\"/>\n"
    );
    let mut shapes: BTreeMap<&str, Shapes> = BTreeMap::new();
    let mut texts = String::new();
    for row in 0..screen.area.height {
        let y = f64::from(row) * cell_height;
        // The run of text so far: its first column, its colour and its characters.
        let mut run: Option<(u16, &str, String)> = None;
        for column in 0..=screen.area.width {
            let cell = screen.cell((column, row));
            let symbol = cell.and_then(|cell| cell.symbol().chars().next());
            let at = [f64::from(column) * cell_width, y];
            let mut text = None;
            if let (Some(cell), Some(c)) = (cell, symbol) {
                let [fg, bg] = colours(cell);
                if bg != BACKGROUND {
                    draw('█', at, shapes.entry(bg).or_default());
                }
                if c != ' ' && !draw(c, at, shapes.entry(fg).or_default()) {
                    text = Some((fg, c));
                }
            }
            run = match (run, text) {
                (Some((first, fg, mut text)), Some((colour, c))) if fg == colour => {
                    text.push(c);
                    Some((first, fg, text))
                }
                (ended, next) => {
                    if let Some((first, fg, text)) = ended {
                        let (x, y) = (f64::from(first) * cell_width, y + 12.0);
                        let length = text.chars().count() as f64 * cell_width;
                        let text = escaped(&text);
                        let _ = writeln!(
                            texts,
                            "<text x=\"{x}\" y=\"{y}\" textLength=\"{length}\" fill=\"{fg}\">{text}</text>"
                        );
                    }
                    next.map(|(fg, c)| (column, fg, c.to_string()))
                }
            };
        }
    }
    for (colour, Shapes { areas, lines }) in shapes {
        if !areas.is_empty() {
            let _ = writeln!(picture, "<path d=\"{areas}\" fill=\"{colour}\"/>");
        }
        if !lines.is_empty() {
            let _ = writeln!(picture, "<path d=\"{lines}\" stroke=\"{colour}\"/>");
        }
    }
    picture + &texts + "</svg>\n"
}
