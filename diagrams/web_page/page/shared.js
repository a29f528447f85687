'use strict';
// A diagram that runs in a page: what all of the script shares. Nothing is loaded from anywhere.

const data = JSON.parse(document.getElementById('lw-data').textContent);
const $ = name => document.getElementById(name);
let cursor = null, running = false;  // where the pointer is over a plot, in pixels; whether it runs
